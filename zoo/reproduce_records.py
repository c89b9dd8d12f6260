"""The records of a reproduction: what each is of, whether it is whole, and whether a run that has ended can leave one."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from zoo.runs import Run
from zoo.sweep_plan import in_one_line
from zoo.sweep_run import Place
from zoo.typed_settings import convert

Record = dict[str, Any]
Number = float | None  # null is what was not a number

IN_A_RUN = "record.json"
"""A copy of the record in the folder of its run, from which it can be put back."""

SCRIPTED_KEYS = {
    "identity": dict[str, Any],
    "date": str,
    "machine": dict[str, Any],
    "versions": dict[str, str],
    "test": dict[str, Any],
}
RUN_KEYS = {
    **SCRIPTED_KEYS,
    "command": str,
    "taken": dict[str, float],
    "curve": dict[str, dict[str, list[Number]]],
}
IDENTITY_KEYS = {
    **dict.fromkeys(("experiment", "cell", "algo", "env"), str),
    **{"scale": float, "seed": int, "tests": dict[str, dict[str, str]], "test_episodes": int, "settings": dict[str, Any]},
}
TEAMS = dict[str, dict[str, Any]]
TEST_KEYS = {"seeds": tuple[int, int], "tests": dict[str, dict[str, Any]]}
OF_A_TEST = {"mean": dict[str, Number], "returns": dict[str, list[Number]]}


def read_record(path: Path) -> Record:
    """
    A record, of a run or of scripted policies.

    :raises ValueError: if it is damaged
    """
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"the record {path} cannot be read: {error}") from None
    if not isinstance(record, dict) or not isinstance(record.get("identity"), dict):
        raise ValueError(f"{path} is no record of zoo/reproduce.py")
    try:
        return _whole(record)
    except ValueError as error:
        raise ValueError(f"the record {path} is damaged: {error}") from None


def _whole(record: Record) -> Record:
    """
    A record with all its parts, its numbers as numbers.

    :raises ValueError: for what is missing, or is of another type
    """
    is_of_a_run = "players" not in record["identity"]
    whole = {**record, **_parts("", record, RUN_KEYS if is_of_a_run else SCRIPTED_KEYS)}
    whole["test"] = {**record["test"], **_parts("test.", record["test"], TEST_KEYS)}
    whole["test"]["tests"] = {
        name: {**own, **_parts(f"test.tests.{name}.", own, OF_A_TEST)} for name, own in whole["test"]["tests"].items()
    }
    _parts("machine.", record["machine"], {"processor": str, "cores": int})
    if not is_of_a_run:
        return whole
    settings = _parts("identity.", record["identity"], IDENTITY_KEYS)["settings"]
    _parts("identity.settings.", settings, {"n_timesteps": int})
    if settings.get("teams") is not None:
        for team, own in _parts("identity.settings.", settings, {"teams": TEAMS})["teams"].items():
            _parts(f"identity.settings.teams.{team}.", own, {"algo": str})
    for name, taken in _parts("taken.", record["taken"], dict.fromkeys(("wall", "processor", "memory"), float)).items():
        if not taken > 0:
            raise ValueError(f"its taken.{name} is {taken:g}; it must be above 0")
    for name, curve in whole["curve"].items():
        times = _parts(f"curve.{name}.", curve, dict.fromkeys(("steps", "episodes"), list[float]))["steps"]
        if not times or {len(values) for values in curve.values()} != {len(times)}:
            raise ValueError(f"its curve {name} has not one value of everything at each evaluation")
    return whole


def _parts(prefix: str, given: Mapping[str, Any], known: Mapping[str, Any]) -> dict[str, Any]:
    """
    The parts that must be there.

    :param prefix: of their names, for the message
    :param given: these and others
    :param known: name → type hint
    :raises ValueError: for one that is missing, or of another type
    """
    found = {}
    for name, hint in known.items():
        try:
            found[name] = convert(given[name], hint)
        except (KeyError, TypeError):
            raise ValueError(f"its {prefix}{name} is missing, or of another type") from None
    return found


def is_there(path: Path, identity: Mapping[str, Any]) -> bool:
    """
    Whether there is a record of just this.

    :param path: where it would be
    :param identity: what it is to be of
    :raises ValueError: if it is of something else, with the first difference, or damaged
    """
    if not path.is_file():
        return False
    require_same(f"the record {path}", identity, read_record(path)["identity"], "the record and its run")
    return True


def require_same(what: str, ours: Mapping[str, Any], theirs: Mapping[str, Any], to_remove: str) -> None:
    """
    :param what: was measured
    :param ours: what it is to be of
    :param theirs: what it is of
    :param to_remove: so that it is measured anew
    :raises ValueError: if these differ, with the first difference
    """
    for name, one, other in differences(ours, theirs):
        raise ValueError(
            f"{what} was measured with {name} {in_one_line(other)}, and is now to have {in_one_line(one)}; "
            f"choose another scale, or other settings by another name, or remove {to_remove} to measure anew"
        )


def differences(ours: Mapping[str, Any], theirs: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any, Any]]:
    """In what two identities differ: name, and the value of each."""
    for name in {**ours, **theirs}:
        one, other = ours.get(name), theirs.get(name)
        if isinstance(one, dict) and isinstance(other, dict):
            yield from differences(one, other, f"{prefix}{name}.")
        elif one != other:
            yield f"{prefix}{name}", one, other


def measured_file(place: Place) -> Path:
    """Where a run that ends leaves its test, and what it took."""
    return place.log.with_suffix(".measured.json")


def tested(identity: Mapping[str, Any]) -> dict[str, Any]:
    """What a test is of."""
    return {name: identity[name] for name in ("tests", "test_episodes")}


def read_measured(place: Place, identity: Mapping[str, Any]) -> dict[str, Any]:
    """
    The test of a run that has ended, and what the run took.

    :param place: of the run
    :param identity: what its record is to be of
    :raises ValueError: if it is missing, damaged or of another test
    """
    path = measured_file(place)
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        of = found["of"]
    except (OSError, ValueError, KeyError, TypeError):
        raise ValueError(f"{path}, the test of a run that has ended, is missing or damaged; remove {_folder(place)}") from None
    require_same(f"the run {_folder(place)}", tested(identity), of, "this folder")
    return found


def record_in_the_run(place: Place, identity: Mapping[str, Any]) -> Path | None:
    """
    The copy of the record that a run keeps which has ended.

    :param place: of the run
    :param identity: what the record is to be of
    :return: ``None`` if the run has not ended, or what the record is made of is all there
    :raises ValueError: if there can be no such record of this run
    """
    run = place.run()
    if run is None or not run.has_ended:
        return None
    copy = _copy_in(run)
    if copy.is_file():
        require_same(f"the run {run.folder.path}", identity, read_record(copy)["identity"], "this folder, too,")
        return copy
    if not run.folder.monitor_file.is_file():
        raise ValueError(
            f"the run {run.folder.path} has ended, and its record is gone, as is {run.folder.monitor_file.name}; "
            "remove this folder, too, to measure anew"
        )
    read_measured(place, identity)
    return None


def _copy_in(run: Run) -> Path:
    return run.folder.path / IN_A_RUN


def _folder(place: Place) -> str:
    run = place.run()
    return str(run.folder.path if run else place.log.parent)
