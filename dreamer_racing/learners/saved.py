"""Checks that the saved state of a learner fits the learner that loads it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any, NamedTuple

from torch import Tensor, nn

from dreamer_racing.modules import Agent, ModelSize

VARIANTS = ("sampled", "state_std")
"""Fields of `ModelSize` with command-line options of their own, such as ``model.sampled=false``."""
Parts = dict[str, tuple[dict[str, Tensor], dict[str, Tensor]]]
"""Expected and saved state of each part of a learner, by the part's name."""


def own_state(network: nn.Module, agent: Agent) -> dict[str, Tensor]:
    """Return a network's state without the tensors that it shares with the agent."""
    shared = {id(tensor) for tensor in agent.state_dict(keep_vars=True).values()}
    state = network.state_dict(keep_vars=True)
    return {key: tensor.detach() for key, tensor in state.items() if id(tensor) not in shared}


def check_saved(saved: dict[str, Any], algorithm: str, agent: Agent, own_networks: Mapping[str, nn.Module]) -> None:
    """Check that ``state_dict()`` of a learner can be resumed by this one.

    Raises:
        ValueError: If it was saved with another algorithm, model size, loss or environment.
    """
    check_format(saved)
    if saved["algorithm"] != algorithm:
        raise ValueError(
            f"The checkpoint was trained with {saved['algorithm']}, and this learner is {algorithm}: use "
            f"{saved['algorithm']}, or start a new run with its weights (init_from=)."
        )
    check_size(saved["size"], agent.size)
    parts: Parts = {"networks": (agent.state_dict(), saved["agent"])}
    for name, network in own_networks.items():
        parts[name] = own_state(network, agent), saved["own_networks"].get(name, {})
    _check_parts(parts, saved, agent)


class UnmatchedWeights(NamedTuple):
    """Names of networks outside the agent that only one of two learners has."""

    initial: list[str]
    """Networks of the loading learner only; they keep their initial weights."""
    unused: list[str]
    """Networks of the saved learner only; they are not loaded."""


def check_weights(saved: dict[str, Any], agent: Agent, own_networks: Mapping[str, nn.Module]) -> UnmatchedWeights:
    """Check that the weights of a saved learner can be loaded, whatever its algorithm.

    Of the networks outside the agent those that were also saved must have the same shapes.

    Raises:
        ValueError: If it was saved with another model size or environment.
    """
    check_format(saved)
    check_size(saved["size"], agent.size)
    parts: Parts = {"networks": (agent.state_dict(), saved["agent"])}
    here = {name: own_state(network, agent) for name, network in own_networks.items()}
    there = saved["own_networks"]
    ours, theirs = _names(here), _names(there)
    for name, state in here.items():
        wanted = {key: value for key, value in state.items() if _name(name, key) in theirs}
        parts[name] = wanted, {key: there[name][key] for key in wanted if key in there[name]}
    _check_parts(parts, saved, agent)
    return UnmatchedWeights(sorted(ours - theirs), sorted(theirs - ours))


def check_format(saved: dict[str, Any]) -> None:
    """Raise ``ValueError`` if the state of a learner has an older format."""
    if "own_networks" not in saved:
        raise ValueError("The checkpoint was saved in a format that this version does not read: train again.")


def load_parameters(module: nn.Module, saved: Mapping[str, Tensor]) -> None:
    """Load the parameters of a module from a state, but not its buffers."""
    own = dict(module.named_parameters())
    module.load_state_dict({name: value for name, value in saved.items() if name in own}, strict=False)


def check_size(checkpoint: dict[str, Any], size: ModelSize) -> None:
    """Check that a saved model, ``state_dict()["size"]`` of a learner, has this size.

    Raises:
        ValueError: If they differ in anything but the name; the message gives the differences and what to do.
    """
    wanted = asdict(size)
    names = [field.name for field in fields(size) if field.name != "name"]
    other = [name for name in names if _plain(checkpoint.get(name)) != _plain(wanted[name])]
    if other:
        differences = "; ".join(f"{name} {checkpoint.get(name)} there, {wanted[name]} here" for name in other)
        variants = [f"model.{name}={str(checkpoint.get(name)).lower()}" for name in other if name in VARIANTS]
        start = " ".join([f"model={checkpoint.get('name')}", *variants])
        raise ValueError(
            f"The checkpoint holds a model of size {checkpoint.get('name')!r}, but this learner was made with size "
            f"{size.name!r} ({differences}). Weights cannot be converted between sizes: start with {start} to use this "
            f"checkpoint, or train size {size.name!r} from the beginning."
        )


def _plain(value: Any) -> Any:
    """Return a tuple as a list, as files store it."""
    return list(value) if isinstance(value, tuple) else value


def _name(network: str, key: str) -> str:
    """Return the reported name of a parameter's network; each target of the world-model loss counts as a network."""
    return key.partition(".")[2].partition(".")[0] if key.startswith("targets.") else network


def _names(states: Mapping[str, Mapping[str, Tensor]]) -> set[str]:
    return {_name(network, key) for network, state in states.items() for key in state}


def _check_parts(parts: Parts, saved: dict[str, Any], agent: Agent) -> None:
    """Raise ``ValueError`` if the names or shapes of expected and saved parameters differ."""
    there, here = saved["image_size"], agent.interface.image_size
    where = (
        "in an environment with other observations or actions"
        if there == here
        else f"on images of {there} × {there} pixels, not {here} × {here}: choose env.image_size={there}"
    )
    for part, (wanted, found) in parts.items():
        lacking, surplus = sorted(wanted.keys() - found.keys()), sorted(found.keys() - wanted.keys())
        if lacking or surplus:
            raise ValueError(
                f"Compared with this learner's {part}, the checkpoint's has {', '.join(surplus[:2]) or 'nothing'} in "
                f"addition, and lacks {', '.join(lacking[:2]) or 'nothing'}: it was trained with another loss or other "
                "observations. Use those it was trained with."
            )
        for key, value in wanted.items():
            if value.shape != found[key].shape:
                raise ValueError(
                    f"The checkpoint's {part} has {key} of shape {list(found[key].shape)}, this learner's has shape "
                    f"{list(value.shape)}: it was trained {where}."
                )
