"""Licences of dependencies: every direct one is on the page, and what is read is what a package states."""

from __future__ import annotations

from email.message import Message

import pytest

from lab import licences


class Package:
    def __init__(self, **fields: str | list[str]) -> None:
        self.metadata = Message()
        for name, values in fields.items():
            for value in [values] if isinstance(values, str) else values:
                self.metadata[name.replace("_", "-")] = value


@pytest.mark.parametrize(("package", "told"), [
    (Package(License_Expression="MIT", License="text"), "MIT"),
    (Package(Classifier=["License :: OSI Approved", "License :: OSI Approved :: BSD License", "Topic :: X"]), "BSD License"),
    (Package(License="Apache 2.0"), "Apache 2.0"),
    (Package(License="Copyright (c) somebody " * 9), ""),
    (Package(), ""),
])
def test_a_licence_is_what_the_package_states(package: Package, told: str) -> None:
    assert licences.licence(package) == told


def test_every_direct_dependency_is_on_the_page() -> None:
    text = licences.PAGE.read_text()
    names = [licences.normal(one.name) for group in licences.stated().values() for one in group]
    assert {"torch", "viser", "usd-core"} <= set(names)
    assert [name for name in names if f"\n|{name}|" not in text] == []
    assert "none stated" not in text
