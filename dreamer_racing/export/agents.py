"""The agents that ship, by their names; no torch."""

from __future__ import annotations

from pathlib import Path

PACKAGE = Path(__file__).parents[1]
AGENTS = next((path for path in (PACKAGE / "agents", PACKAGE.parent / "agents") if path.is_dir()), PACKAGE / "agents")
"""Their folder: an installed package holds it, a clone has it beside the package."""


def agent_path(name: str) -> Path:
    """Return the folder of an agent that ships, by its name; else the path that the name is."""
    named = AGENTS / name
    return named if Path(name).name == name and (named / "agent.json").is_file() else Path(name)


def existing_agent_path(setting_name: str, name: str) -> Path:
    """Return what `agent_path` does, of something that is there.

    Raises:
        FileNotFoundError: nothing is; the message names the setting, and the agents that ship.
    """
    path = agent_path(name)
    if not path.exists():
        raise FileNotFoundError(f"{setting_name}={name}: there is no such file or folder. {agents_that_ship()}")
    return path


def agents_that_ship() -> str:
    """Return a sentence that names them."""
    return f"Agents that ship, to be given by name: {', '.join(agents_in(AGENTS)) or 'none'}."


def agents_in(folder: Path) -> list[str]:
    """Return the names of the agents that lie in a folder, sorted."""
    return sorted(path.parent.name for path in folder.glob("*/agent.json"))
