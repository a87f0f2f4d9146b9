"""Every runtime dependency, and theirs, has a wheel for other versions of Python on Linux.

    python scripts/check_wheels.py 3.12 3.13

Resolves the dependencies of pyproject.toml with pip, installs nothing. Ends with code 1 and names the reason where a wheel is
missing or no package index can be reached: a check that cannot be made has not passed.
"""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path
from tempfile import TemporaryDirectory

PROJECT = Path(__file__).parents[1] / "pyproject.toml"
"""Where the dependencies are stated."""


def resolve(requirements: list[str], version: str) -> str:
    """Resolve requirements to wheels for a version of Python; returns pip's complaint, empty when all are found."""
    with TemporaryDirectory() as folder:
        done = subprocess.run(
            [sys.executable, "-m", "pip", "install", "--dry-run", "--quiet", "--ignore-installed", "--only-binary", ":all:",
             "--retries", "3", "--timeout", "20", "--python-version", version, "--target", folder, *requirements],
            capture_output=True, text=True)
    if done.returncode == 0:
        return ""
    errors = [line for line in done.stderr.splitlines() if line.startswith("ERROR")]
    return "\n".join(errors) or done.stderr.strip() or f"pip ended with code {done.returncode}"


def main(versions: list[str]) -> int:
    """Check each version; returns the exit code."""
    requirements = tomllib.loads(PROJECT.read_text())["project"]["dependencies"]
    failed = False
    for version in versions:
        complaint = resolve(requirements, version)
        failed |= bool(complaint)
        if complaint:
            print(f"Python {version}: a runtime dependency has no wheel, or no package index answers:\n{complaint}",
                  file=sys.stderr)
        else:
            print(f"Python {version}: every runtime dependency has a wheel")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
