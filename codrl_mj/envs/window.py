"""A window on the screen, for the render mode `human`."""

from typing import Any

import numpy as np
from gymnasium.error import DependencyNotInstalled


class Window:
    """Shows images one after another, no faster than a frame rate."""

    def __init__(self, width: int, height: int) -> None:
        """Open it, for images of a size [px]."""
        try:
            import pygame
        except ImportError:
            raise DependencyNotInstalled("render_mode = 'human' needs pygame: pip install pygame-ce") from None
        self._pygame: Any = pygame
        pygame.display.init()
        self._screen = pygame.display.set_mode((width, height))
        self._clock = pygame.time.Clock()

    def show(self, image: np.ndarray, rate: float) -> None:
        """Show an image (height, width, 3), uint8, at most at a rate [1/s]: waits as long as it must."""
        self._screen.blit(self._pygame.surfarray.make_surface(image.swapaxes(0, 1)), (0, 0))
        self._pygame.event.pump()
        self._clock.tick(rate)
        self._pygame.display.flip()

    def close(self) -> None:
        """Close it."""
        self._pygame.display.quit()
