"""The policies that come with the package: a zip and its model card (JSON) each."""

from __future__ import annotations

from pathlib import Path


def shipped_policies() -> dict[str, Path]:
    """The zips of the shipped policies by name; each has a model card of the same name beside it."""
    return {path.stem: path for path in sorted(Path(__file__).parent.glob("*.zip"))}
