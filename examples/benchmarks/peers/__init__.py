"""Jobs for other programs, and the scripts that do them there: each runs by itself, in an environment of its own."""
