"""Damage to files, as by a failing disk or a transfer in text mode, and on purpose."""

from pathlib import Path


class Bomb:
    """Object that creates a file when it is unpickled."""

    def __init__(self, marker):
        """Take the file's path."""
        self.marker = marker

    def __reduce__(self):
        return Path.touch, (self.marker,)


def damage(content, random):
    """Return the content with one to four bytes changed, by random values or by a flipped low bit.

    With a flipped low bit, text often stays text.

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
