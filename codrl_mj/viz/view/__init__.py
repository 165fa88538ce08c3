"""A simulation to be watched and disturbed while it runs: in a browser, or in MuJoCo's own viewer."""
