"""The joints of robots as unknowns of implicit steps."""
