"""What is refused before workers begin, in plain words; no Ray is needed to know it."""

from __future__ import annotations

import importlib.util

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


@pytest.mark.parametrize(
    ("share", "words"),
    [
        (Share(1.0, 0.0), r"num_workers=4 with workers\.cpus=1 need 4 CPUs, and .* has 3, of which 2 are free"),
        (Share(0.5, 0.5), r"num_workers=4 with workers\.gpus=0\.5 need 2 GPUs, and .* has 0, of which 0 are free"),
    ],
)
def test_what_a_cluster_does_not_have_is_not_waited_for(share: Share, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        check_resources(4, share, {"CPU": 3.0}, {"CPU": 2.0})
    check_resources(2, Share(1.0, 0.0), {"CPU": 3.0}, {"CPU": 2.0})


def test_nodes_of_other_versions_are_refused() -> None:
    here = {"python": "3.11.2", "torch": "2.13.0", "ray": "2.60.0"}
    check_versions("one", here, here)
    words = r"node two has torch 2\.12\.0 \(here 2\.13\.0\), ray None \(here 2\.60\.0\)\. Install the same there"
    with pytest.raises(ValueError, match=words):
        check_versions("two", {"python": "3.11.2", "torch": "2.12.0"}, here)
