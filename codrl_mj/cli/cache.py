"""`codrl-mj cache`."""

import dataclasses
from typing import Annotated

import tyro


@dataclasses.dataclass(frozen=True)
class Cache:
    """Show what compiled code is kept on disk, which saves seconds in every process after the first, or clear it.

    CODRL_MJ_CACHE names another folder; CODRL_MJ_CACHE=off keeps nothing. Code that does not fit any more is never
    used, so that nothing has to be cleared: docs/engine.md.

    Example: codrl-mj cache --clear
    """

    clear: Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(help="Delete it.")] = False

    def run(self) -> int:
        """Show or clear."""
        from codrl_mj import kept

        place = kept.folder()
        if place is None:
            print("off: CODRL_MJ_CACHE says so")
            return 0
        files = [*place.glob("*.code")]
        size = sum(file.stat().st_size for file in files) / 1e6
        told = f"{len(files)} file{'' if len(files) == 1 else 's'}, {size:.1f} MB" if files else "empty"
        if self.clear:
            for file in files:
                file.unlink(missing_ok=True)
        print(f"{place}: {told}" + (", cleared" if self.clear and files else f"; at most {kept.MOST / 1e6:.0f} MB"))
        return 0
