"""Motors in models of other people's, behind MuJoCo's plugin."""
