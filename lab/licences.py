"""List the licences of all packages that an installation with all extras brings, in docs/licences.md.

    python -m lab.licences [--check]

They are read from what is installed; a package that states none in a field is looked up by its classifiers. `--check` changes
nothing, and ends with code 1 where a package states nothing or a direct dependency is not on the page.
"""

from __future__ import annotations

import argparse
import re
import sys
import tomllib
from collections.abc import Iterable, Sequence
from importlib.metadata import Distribution, PackageNotFoundError, distribution

from packaging.requirements import Requirement

from dro_grasp.files import replacing
from lab.benchmarks.report import ROOT
from lab.reading import table

PAGE = ROOT / "docs" / "licences.md"
OWN = "dro-grasp"
LEFT_OUT = ("dev",)
"""Extras without packages that users get: tools of development."""
BY_FILE = {"embreex": "BSD-2-Clause", "vhacdx": "MIT"}
"""What licence files say of packages that name no licence."""
ELSEWHERE = {"robot-descriptions": "Apache-2.0", "tensorboard": "Apache-2.0"}
"""What the index says of direct dependencies that the development tools go without."""
LONGEST = 60
"""Longest licence that is a name and no text."""


def stated() -> dict[str, list[Requirement]]:
    """Direct requirements by extra; the core has the empty name."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = {name: lines for name, lines in project["optional-dependencies"].items() if name not in LEFT_OUT}
    return {name: [Requirement(line) for line in lines] for name, lines in {"": project["dependencies"], **extras}.items()}


def needed() -> dict[str, list[str]]:
    """Every package that is installed by them, by normal name, with the extras that bring it."""
    found: dict[str, list[str]] = {}
    for extra, requirements in stated().items():
        seen, left = set[str](), list(requirements)
        while left:
            one = left.pop()
            name = normal(one.name)
            if (key := f"{name} {sorted(one.extras)}") in seen:
                continue
            seen.add(key)
            if extra not in found.setdefault(name, []):
                found[name].append(extra)
            left += inner(one)
    return dict(sorted(found.items()))


def inner(requirement: Requirement) -> list[Requirement]:
    """What a package that is installed requires here."""
    if (package := installed(requirement.name)) is None:
        return []
    lines = [Requirement(line) for line in package.requires or ()]
    asked = ["", *requirement.extras]
    return [line for line in lines if line.marker is None or any(line.marker.evaluate({"extra": extra}) for extra in asked)]


def installed(name: str) -> Distribution | None:
    """The package, if it is installed."""
    try:
        return distribution(name)
    except PackageNotFoundError:
        return None


def licence(package: Distribution) -> str:
    """What a package states: an expression, else classifiers, else a short text."""
    told = package.metadata
    if expression := told["License-Expression"]:
        return expression
    classified = [line.rpartition(" :: ")[2] for line in told.get_all("Classifier") or () if line.startswith("License :: ")]
    if classified := [name for name in classified if name != "OSI Approved"]:
        return ", ".join(classified)
    text = " ".join((told["License"] or "").split())
    return text if 0 < len(text) <= LONGEST else ""


def normal(name: str) -> str:
    """A package's name as the index compares it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def rows() -> list[list[str]]:
    """Packages that are installed, their licences, and what brings them."""
    found = []
    for name, extras in needed().items():
        package = installed(name)
        told = ELSEWHERE.get(name, "") if package is None else licence(package) or BY_FILE.get(name, "none stated")
        if name != OWN and told:
            found.append([name, told, "core" if "" in extras else ", ".join(f"`{extra}`" for extra in extras)])
    return found


def page(lines: Iterable[Sequence[str]]) -> str:
    """The page of them."""
    told = ("dro-grasp is under the MIT licence. It installs these packages, whose licences are as they state them. A build\n"
            "of PyTorch for GPUs brings packages of NVIDIA besides. `make licences` lists them anew.")
    return (f"# Licences of dependencies\n\n{told}\n\n" + table(["package", "licence", "comes with"], list(lines)) + "\n")


def main(argv: Sequence[str] | None = None) -> int:
    """Write the page, or check it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="change nothing")
    options = parser.parse_args(argv)
    lines = rows()
    if not options.check:
        with replacing(PAGE) as temporary:
            temporary.write_text(page(lines))
    text = PAGE.read_text()
    unknown = [name for name, told, _ in lines if told == "none stated"]
    lacking = [one.name for group in stated().values() for one in group if f"|{normal(one.name)}|" not in text]
    for what, names in (("states no licence", unknown), ("is not on the page, or not installed", lacking)):
        for name in names:
            print(f"{name} {what}", file=sys.stderr)
    return int(bool(unknown or lacking))


if __name__ == "__main__":
    sys.exit(main())
