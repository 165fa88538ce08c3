"""Damage to files: as a failing disk or a careless transfer does it, and on purpose."""

from pathlib import Path


class Bomb:
    """Leaves a file where it is unpickled."""

    def __init__(self, marker):
        """Take the file's path."""
        self.marker = marker

    def __reduce__(self):
        return Path.touch, (self.marker,)


def damage(content, random):
    """The content with one to four bytes changed: other ones anywhere, or a bit flipped, which often is text still.

    Args:
        content: bytes.
        random: a `random.Random`.
    """
    damaged = bytearray(content)
    while damaged == content:
        for _ in range(random.randint(1, 4)):
            flip = 1 << random.randrange(3) if random.random() < 0.7 else random.randrange(256)
            damaged[random.randrange(len(damaged))] ^= flip
    return bytes(damaged)
