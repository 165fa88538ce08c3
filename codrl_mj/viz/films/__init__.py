"""Films of episodes, and the strip of signals under the scene."""
