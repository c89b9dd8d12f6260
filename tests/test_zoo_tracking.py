"""What a run tells TensorBoard's HParams page and Weights & Biases (offline)."""

import json
import struct

import pytest
import wandb
import yaml
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams import metadata
from wandb.proto import wandb_internal_pb2

from zoo import cli, train
from zoo.run_folder import RunFolder
from zoo.series import tensorboard_series
from zoo.tracking import as_cells

BLOCK, HEADER, FILE_HEADER = 32_768, 7, 7
FULL, LAST = 1, 4


def command(folder, *more):
    return [
        *("--algo", "maddpg", "--env", "HardSpread-v0", "-n", "120", "--seed", "1", "-f", str(folder), "--verbose", "0"),
        *("--eval-freq", "60", "--eval-episodes", "2", "--log-interval", "4", "--env-kwargs", "n_agents:2", "max_steps:5"),
        *("-params", "n_envs:2", "learning_starts:20", "batch_size:8", "policy_kwargs.n_critics:2", *more),
    ]


def records(path):
    """What a file of Weights & Biases holds: LevelDB's log format, each record a protocol buffer."""
    data, place, message = path.read_bytes(), FILE_HEADER, b""
    while place < len(data):
        if BLOCK - place % BLOCK < HEADER:
            place += BLOCK - place % BLOCK
            continue
        _, size, kind = struct.unpack_from("<IHB", data, place)
        place += HEADER
        message += data[place : place + size]
        place += size
        if kind in (FULL, LAST):
            record = wandb_internal_pb2.Record()
            record.ParseFromString(message)
            message = b""
            yield record


def history(path):
    """Tag → env steps → value."""
    found = {}
    for record in records(path):
        if record.WhichOneof("record_type") == "history":
            row = {item.key or "/".join(item.nested_key): json.loads(item.value_json) for item in record.history.item}
            for tag, value in row.items():
                found.setdefault(tag, {})[row["env_steps"]] = value
    return found


def test_wandb_is_told_what_tensorboard_is(tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "offline")
    assert train.main(command(tmp_path, "--track", "--wandb-tags", "fast", "small", "--run-name", "my run")) == 0
    wandb.teardown()  # as at the end of a process: all is in the file
    folder = RunFolder(tmp_path / "maddpg" / "HardSpread-v0_1", "HardSpread-v0")
    (file,) = folder.path.glob("wandb/offline-run-*/run-*.wandb")

    (run,) = [record.run for record in records(file) if record.WhichOneof("record_type") == "run"]
    config = {item.key: json.loads(item.value_json) for item in run.config.update}
    assert (run.display_name, list(run.tags), run.project) == ("my run", ["fast", "small"], "sb3-kfcv")
    assert config["policy_kwargs"] == {"net_arch": [64, 64], "n_critics": 2} and config["seed"] == 1
    assert run.run_id == yaml.safe_load(folder.arguments_file.read_text())["wandb_id"]  # by which a resumed run is known

    told, logged = history(file), tensorboard_series(folder.path)
    assert {"eval/mean_reward", "train/critic_loss", "rollout/ep_rew_mean"} <= set(logged)
    for tag, series in logged.items():
        if not tag.startswith("time/"):
            expected = {
                int(step): pytest.approx(value, rel=1e-6) for step, value in zip(series.steps, series.values, strict=True)
            }
            assert {step: told[tag][step] for step in expected} == expected


def test_settings_are_on_the_hparams_page(tmp_path):
    assert train.main(command(tmp_path)) == 0
    events = EventAccumulator(str(tmp_path / "maddpg" / "HardSpread-v0_1"))
    events.Reload()
    page = events.PluginTagToContent("hparams")
    start = metadata.parse_session_start_info_plugin_data(page[metadata.SESSION_START_INFO_TAG])
    compared = metadata.parse_experiment_plugin_data(page[metadata.EXPERIMENT_TAG]).metric_infos
    assert start.hparams["policy_kwargs.n_critics"].number_value == 2
    assert start.hparams["algo"].string_value == "maddpg"
    logged = events.Tags()["scalars"]
    assert [info.name.tag for info in compared] and all(info.name.tag in logged for info in compared)


def test_settings_as_cells():
    nested = {"a": {"b": 1, "c": {"d": True}}, "e": [64, 64], "f": None, "g": 0.5}
    assert as_cells(nested) == {"a.b": 1, "a.c.d": True, "e": "[64, 64]", "f": "None", "g": 0.5}


def test_flags_of_tracking_alone_are_refused(tmp_path, capsys):
    assert train.main(command(tmp_path, "--run-name", "mine")) == 2
    assert capsys.readouterr().err == "error: --run-name is for runs that are tracked: add --track\n"
    assert not list(tmp_path.iterdir())


def test_without_wandb(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert train.main(command(tmp_path, "--track")) == 2
    assert 'pip install "sb3-kfcv[track]"' in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_who_is_not_logged_in_is_told_in_one_sentence(tmp_path, capsys, monkeypatch):
    def init(**settings):
        raise wandb.errors.UsageError("No API key\nconfigured.")

    monkeypatch.setattr(wandb, "init", init)
    assert train.main(command(tmp_path, "--track")) == 2
    expected = "No API key configured. (log in with `wandb login`, or keep the records here with WANDB_MODE=offline)\n"
    assert capsys.readouterr().err.endswith(expected)
    assert not list(tmp_path.rglob("HardSpread-v0*"))


def test_a_mode_that_there_is_not_is_told_in_one_sentence(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "ofline")
    assert train.main(command(tmp_path, "--track")) == 2
    (sentence,) = capsys.readouterr().err.splitlines()
    assert sentence.startswith("error: Weights & Biases does not take the run: ") and "online" in sentence
    assert not list(tmp_path.rglob("HardSpread-v0*"))


def test_the_console_script(capsys):
    assert cli.main(["--help"]) == 0
    shown = capsys.readouterr().out
    assert all(f"  {name} " in shown for name in cli.COMMANDS)
    assert cli.main(["trian"]) == 2
    assert capsys.readouterr().err == 'error: unknown command "trian"; did you mean "train"?\n'
    assert cli.main(["train", "--env", "Graslnd-v0"]) == 2
    assert capsys.readouterr().err == 'error: unknown environment "Graslnd-v0"; did you mean "Grassland-v0"?\n'
