"""Films of episodes, with plots of signals below the scene."""
