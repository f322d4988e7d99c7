"""The origin of a run's upstream runs: which weights it builds upon, and what these were made by.

The id of an upstream run says how it is trained, not which weights came of it: trained again, or on another
machine, it has others. So the manifest of a run has both, as they were when it began.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from memmlp.runs.recipe_versions import first_of_vqvae
from memmlp.runs.resumed_origin import MACHINE, UPSTREAM
from memmlp.runs.run import Run

FACTS = ("recipes", "git", "version", "sources", "plugins", "packages", *MACHINE)
"""What the manifest of an upstream run has on its code and its machine."""


def upstream_origins(upstream: Run | None) -> list[dict[str, Any]]:
    """Return the origins of the runs upstream of a run that begins, for its manifest; the nearest run first.

    Each has the upstream run's `id` and `kind`, the SHA-256 of its `weights`, and FACTS as far as known.

    Args:
        upstream: the finished run whose weights the run uses; None for none.
    """
    if upstream is None:
        return []
    manifest = upstream.manifest
    own = {"id": upstream.id, "kind": manifest.get("kind"), "weights": upstream.weights_digest}
    facts = {name: manifest[name] for name in FACTS if name in manifest}
    return [own | facts, *recorded_upstream(manifest)]


def recorded_upstream(manifest: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the origins of the upstream runs in a run's manifest; none if they were not recorded."""
    return manifest.get(UPSTREAM) or []


def upstream_recipes(run: Run) -> dict[str, int]:
    """Return the recipe versions of the components with which a run's upstream runs were trained.

    Where they were not recorded, a VQ-VAE upstream has the first ones.
    """
    manifest = run.manifest
    every = [one.get("recipes") or {} for one in recorded_upstream(manifest)]
    found = {name: number for recipes in every for name, number in recipes.items()}
    codebook = (run.config.get("vqvae") or {}).get("codebook")
    return found | first_of_vqvae({**found, **(manifest.get("recipes") or {})}, codebook)
