"""Contact of surfaces with themselves and with each other: distances, candidates, forces."""
