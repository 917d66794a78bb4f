"""What is refused before workers begin, in plain words; no Ray is needed to know it."""

from __future__ import annotations

import importlib.util
import socket

import pytest

from dreamer_racing.experience.ray_cluster import Share, check_resources, check_versions, join


def test_without_ray_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"Ray is not installed here.*\[ray\].*collector=local"):
        join("local")


@pytest.mark.parametrize("address", ["auto", "somewhere"])
def test_where_there_is_no_cluster_the_address_is_named(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray", reason="Ray, the extra `ray`, is not installed")

    def refuse(**arguments: object) -> None:
        raise ConnectionError("Could not find any running Ray instance.\nPlease specify another.")

    monkeypatch.setattr("ray.is_initialized", lambda: False)
    monkeypatch.setattr("ray.init", refuse)
    words = rf"workers\.address={address}: no Ray cluster .*\(Could not find .* another\).*workers\.address=local"
    with pytest.raises(ValueError, match=words):
        join(address)


def test_where_nobody_answers_ray_does_not_try_for_minutes(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray", reason="Ray, the extra `ray`, is not installed")
    monkeypatch.setattr("ray.is_initialized", lambda: False)
    with socket.create_server(("127.0.0.1", 0)) as server:  # a port that is nobody's once it is closed
        address = f"127.0.0.1:{server.getsockname()[1]}"
    with pytest.raises(ValueError, match=rf"workers\.address={address}: no Ray cluster .*refused"):
        join(address)


@pytest.mark.parametrize(
    ("share", "words"),
    [
        (Share(1.0, 0.0), r"num_workers=4 with workers\.cpus=1 need 4 CPUs, and .* has 3, of which 2 are free"),
        (Share(0.5, 0.5), r"num_workers=4 with workers\.gpus=0\.5 need 2 GPUs, and .* has 0, of which 0 are free"),
    ],
)
def test_what_a_cluster_does_not_have_is_not_waited_for(share: Share, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        check_resources(4, share, [{"CPU": 2.0}, {"CPU": 1.0}], {"CPU": 2.0})
    check_resources(2, Share(1.0, 0.0), [{"CPU": 3.0}], {"CPU": 2.0})


@pytest.mark.parametrize(
    ("share", "nodes", "room"),
    [
        (Share(1.0, 0.6), [{"CPU": 16.0, "GPU": 2.0}], 2),  # one on each GPU
        (Share(2.0, 0.0), [{"CPU": 3.0}, {"CPU": 3.0}], 2),
        (Share(1.0, 2.0), [{"CPU": 9.0, "GPU": 3.0}, {"CPU": 9.0, "GPU": 3.0}], 2),
        (Share(0.1, 0.1), [{"CPU": 1.0, "GPU": 1.0}], 10),
    ],
)
def test_a_worker_is_not_spread_over_nodes_or_gpus(share: Share, nodes: list[dict[str, float]], room: int) -> None:
    free = {name: sum(node.get(name, 0.0) for node in nodes) + 9.0 for name in ("CPU", "GPU")}
    check_resources(room, share, nodes, free)
    with pytest.raises(ValueError, match=rf"there is room for {room} of them on the cluster's {len(nodes)} nodes"):
        check_resources(room + 1, share, nodes, free)


def test_nodes_of_other_versions_are_refused() -> None:
    here = {"python": "3.11.2", "torch": "2.13.0", "ray": "2.60.0"}
    check_versions("one", here, here)
    words = r"node two has torch 2\.12\.0 \(here 2\.13\.0\), ray None \(here 2\.60\.0\)\. Install the same there"
    with pytest.raises(ValueError, match=words):
        check_versions("two", {"python": "3.11.2", "torch": "2.12.0"}, here)
