"""Live view of a running simulation, in a browser or in MuJoCo's own viewer."""
