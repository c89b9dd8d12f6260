"""Models for playing alone: their actors, without all that only a training needs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sb3_kfcv.saving.archive import open_archive, write_archive
from sb3_kfcv.saving.attributes import without_retired
from sb3_kfcv.saving.files import existing
from sb3_kfcv.saving.saveable import MODEL_KINDS, further_sections, refusals

# Attributes of a model that only its training needs; some name a folder, or grow with the number of worlds.
OF_THE_TRAINING = (
    *("action_noise", "tensorboard_log", "_last_obs", "_last_original_obs", "_last_episode_starts"),
    *("ep_info_buffer", "ep_success_buffer", "_episode_metrics"),
)


def release_model(source: str | Path, target: str | Path) -> None:
    """
    Write a model for playing only: as the algorithm's ``load`` takes it, with the same predictions to the bit, many times
    smaller. It has no critics, targets and optimisers, and refuses to learn.

    :param source: path of a model or a checkpoint
    :param target: path of the new file
    :raises FileFormatError: if the source is damaged, or of another kind
    :raises ValueError: if it was released before
    """
    with open_archive(existing(source), *MODEL_KINDS) as archive:
        with refusals(archive, "attributes"):
            attributes = archive.read("attributes")
            if attributes.get("plays_only"):
                raise ValueError("it was released for playing only before")
            sections: dict[str, Any] = {"attributes": {**_for_playing(attributes), "plays_only": True}}
        with refusals(archive, "parameters"):
            sections["parameters"] = {
                name: {place: tensor for place, tensor in saved.items() if place.startswith("actor.")}
                for name, saved in archive.read("parameters").items()
                if not name.endswith("optimizer")
            }
        for name, teams in further_sections(archive).items():
            with refusals(archive, name):
                sections[name] = {team: _for_playing(own) for team, own in teams.items()}
        if "normalization" in archive:
            sections["normalization"] = archive.read("normalization")
    write_archive(target, "model", sections)


def is_released(model: str | Path) -> bool:
    """
    Whether a model was released for playing only.

    :param model: path of a model or a checkpoint
    :raises FileFormatError: if it is damaged, or of another kind
    """
    with open_archive(existing(model), *MODEL_KINDS) as archive, refusals(archive, "attributes"):
        return bool(archive.read("attributes").get("plays_only"))


def _for_playing(attributes: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in without_retired(dict(attributes)).items() if name not in OF_THE_TRAINING}
