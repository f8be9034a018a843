"""The policies that come with the package: a zip and its model card (JSON) each."""

from __future__ import annotations

from pathlib import Path

from sb3_flock._renamed import current_policy
from sb3_flock.settings import SettingsError, suggest


def shipped_policies() -> dict[str, Path]:
    """The zips of the shipped policies by name; each has a model card of the same name beside it."""
    return {path.stem: path for path in sorted(Path(__file__).parent.glob("*.zip"))}


def policy_path(name: str) -> Path:
    """The zip of a shipped policy, which SB3's ``DDPG.load`` reads, too.

    :raises SettingsError: for another name
    """
    name = current_policy(name)
    shipped = shipped_policies()
    if name not in shipped:
        raise SettingsError(f"policy = {name!r}: one of {', '.join(shipped)} is needed{suggest(name, shipped)}")
    return shipped[name]
