"""Lookup of the included agents by name, without torch."""

from __future__ import annotations

from pathlib import Path

PACKAGE = Path(__file__).parents[1]
AGENTS = next((path for path in (PACKAGE / "agents", PACKAGE.parent / "agents") if path.is_dir()), PACKAGE / "agents")
"""Folder of the included agents: inside an installed package, beside the package in a clone."""


def agent_path(name: str) -> Path:
    """Return the folder of the included agent of this name, else the name as a path."""
    named = AGENTS / name
    return named if Path(name).name == name and (named / "agent.json").is_file() else Path(name)


def existing_agent_path(setting_name: str, name: str) -> Path:
    """Return `agent_path(name)` if it exists.

    Raises:
        FileNotFoundError: it does not; the message names the setting and the included agents.
    """
    path = agent_path(name)
    if not path.exists():
        raise FileNotFoundError(f"{setting_name}={name}: there is no such file or folder. {agents_that_ship()}")
    return path


def agents_that_ship() -> str:
    """Return a sentence that names the included agents, for error messages."""
    return f"Included agents, by name: {', '.join(agents_in(AGENTS)) or 'none'}."


def agents_in(folder: Path) -> list[str]:
    """Return the sorted names of the agents in a folder."""
    return sorted(path.parent.name for path in folder.glob("*/agent.json"))
