"""Put a set of weights where it ships, with checksums, if each file says how it was made.

python -m lab.recipe.pack out/weights --into src/dro_grasp/network/weights [--changed]
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from dro_grasp.files import replacing
from dro_grasp.network.checkpoints import CHECKSUMS, DEFAULT, SMALL, history_of

SET = (DEFAULT, *SMALL)
"""What ships."""
STATED = ("stage", "command", "commit", "version", "samples", "metrics")
"""What each file has to say of its last training, beside the fingerprint of the data."""


def missing(path: Path, changed: bool) -> list[str]:
    """What a file does not say of how it was made; `changed` lets commits with changes and paths of this machine pass."""
    if not path.is_file():
        return ["the file"]
    history: list[dict[str, Any]] = history_of(path) or [{}]
    about = history[-1]
    lacking = [name for name in STATED if not about.get(name) and not (name == "commit" and changed)]
    lacking += [] if about.get("data", {}).get("fingerprint") else ["data.fingerprint"]
    if not changed and any(str(stage.get("commit", "")).endswith("+") for stage in history):
        lacking.append("a commit without changes")
    if not changed and any(" /" in str(stage.get("command", "")) for stage in history):
        lacking.append("a command without paths of this machine (run the recipe with a relative --folder)")
    return lacking


def main(argv: Sequence[str] | None = None) -> int:
    """Check, copy, print; 1 if a file does not say enough."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="weights as the recipe makes them")
    parser.add_argument("--into", type=Path, required=True, help="where they go")
    parser.add_argument("--changed", action="store_true", help="take weights of a commit with changes")
    options = parser.parse_args(argv)
    files = {name: options.folder / f"{name}.safetensors" for name in SET}
    lacking = {name: found for name, path in files.items() if (found := missing(path, options.changed))}
    for name, found in lacking.items():
        print(f"{files[name]} lacks {', '.join(found)}; make it by `make weights` on a clean commit", file=sys.stderr)
    if lacking:
        return 1
    sums = []
    for name, path in files.items():
        target = options.into / f"{name}.safetensors"
        target.parent.mkdir(parents=True, exist_ok=True)
        with replacing(target) as temporary:
            shutil.copyfile(path, temporary)
        sums.append(f"{sha256(target.read_bytes()).hexdigest()}  {name}.safetensors\n")
    with replacing(options.into / CHECKSUMS) as temporary:
        temporary.write_text("".join(sums))
    tell(files, options.into)
    return 0


def tell(files: dict[str, Path], into: Path) -> None:
    """Print how each was made."""
    table = Table(title=f"weights in {into}")
    for column in ("weights", "kB", "stages", "samples", "data", "commit"):
        table.add_column(column)
    for name, path in files.items():
        made = history_of(path)
        table.add_row(name, f"{path.stat().st_size // 1000:,}", ", ".join(each["stage"] for each in made),
                      f"{sum(each.get('samples') or 0 for each in made):,}", made[-1]["data"]["fingerprint"],
                      made[-1]["commit"])
    Console().print(table)


if __name__ == "__main__":
    sys.exit(main())
