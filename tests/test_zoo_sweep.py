"""
Sweeps: which runs a file means, what it is refused for, that nothing runs twice, and that whatever is killed goes on to the
same bits.
"""

import os
import re
import signal
import sys
import textwrap
import threading
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
import yaml
from rich.console import Console
from test_resume import assert_equal_arrays, assert_equal_runs, episodes, series
from test_zoo import ROOT

from sb3_kfcv import MADDPG
from zoo import sweep, sweep_run, sweep_table, train, workers
from zoo.run_folder import RunFolder
from zoo.runs import find_runs
from zoo.sweep_plan import in_one_line, read_plan
from zoo.sweep_table import DONE, FAILED, RUNNING, WAITING, ProgressTable
from zoo.workers import LocalWorkers, Task

TINY = {
    "algos": ["maddpg"],
    "envs": ["HardSpread-v0"],
    "seeds": 1,
    "train": {
        "n-timesteps": 200,
        "eval-freq": 40,
        "eval-episodes": 2,
        "save-freq": 40,
        "keep-checkpoints": -1,
        "verbose": 0,
        "env-kwargs": {"n_agents": 2, "walls": "none", "max_steps": 5},
    },
}
SMALL_LEARNER = {"n_envs": 2, "learning_starts": 20, "batch_size": 8, "buffer_size": 200}


def tiny(path, **changes):
    """A sweep of tiny runs as a YAML file."""
    given = {**TINY, "settings": {"plain": SMALL_LEARNER}, **changes}
    path.write_text(yaml.safe_dump(given))
    return path


def folder_of(run):
    return run.place.run().folder


# ---- the file


def test_every_algorithm_meets_every_world_seed_and_setting(tmp_path):
    file = tmp_path / "many.yml"
    file.write_text(
        """
        algos: [maddpg, kfcv_maddpg]
        envs: [HardSpread-v0, Grassland-v0]
        seeds: [3, 7]
        settings:
          plain: {}
          short: {gamma: 0.9, learning_rate: lin_1e-3, policy_kwargs: {n_critics: 2, net_arch: [16, 8]}}
        train: {preset: tuned, n_timesteps: 1e4, eval-freq: -1, save-replay-buffer: true, env-kwargs: {max_steps: 9}}
        """
    )
    runs = read_plan(file, tmp_path / "out", threads=2)
    assert len(runs) == len({run.place for run in runs}) == 2 * 2 * 2 * 2
    assert [run.seed for run in runs] == [3] * 8 + [7] * 8  # a sweep cut short has all of the first seed

    last = runs[-1]
    assert last.name == "kfcv_maddpg Grassland-v0 short seed 7"
    assert last.place.log == tmp_path / "out" / "short" / "seed_7" / "kfcv_maddpg" / "Grassland-v0.log"
    settings = last.hyperparams
    assert (settings.n_timesteps, settings.env_kwargs["max_steps"], settings.env_kwargs["n_wolves"]) == (10_000, 9, 16)
    assert (settings.model["gamma"], settings.model["learning_rate"]) == (0.9, "lin_1e-3")
    assert settings.model["policy_kwargs"] == {"n_critics": 2, "net_arch": [16, 8]}
    assert runs[0].hyperparams.model["gamma"] == 0.9  # the preset's

    # its words are a command line of zoo/train.py
    args = train.make_parser().parse_all(last.words)
    assert train.resolve(args) == settings
    assert (args.seed, args.eval_freq, args.save_replay_buffer, args.num_threads) == (7, -1, True, 2)
    assert Path(args.log_folder) == tmp_path / "out" / "short" / "seed_7"


def test_teams_decide_on_the_algorithm(tmp_path):
    file = tmp_path / "teams.yml"
    file.write_text("algos: [maddpg]\nenvs: [Grassland-v0]\nseeds: 1\ntrain: {team: [wolf=per_maddpg, sheep=graze]}")
    (run,) = read_plan(file, tmp_path)
    assert (run.algo, run.hyperparams.model["opponents"]) == ("per_maddpg", {"sheep": "graze"})
    assert run.place.log == tmp_path / "seed_0" / "per_maddpg" / "Grassland-v0.log"


@pytest.mark.parametrize("value", [0.95, 1e-5, "lin_1e-3", True, None, [64, 64], {"a": {"b": [1, 2]}}, "a: b", [], {}, -1])
def test_values_survive_the_command_line(value):
    text = in_one_line(value)
    assert "\n" not in text
    assert yaml.safe_load(text) == value


REFUSED = {
    "algo: [maddpg]": 'unknown key of a sweep "algo"; did you mean "algos"?',
    "algos: [madpg]": 'madpg HardSpread-v0 plain: unknown algorithm "madpg"; did you mean "maddpg"?',
    "algos: maddpg": "key of a sweep algos is 'maddpg'; it must be a list of text",
    "algos: []": "algos is missing; a sweep needs algos, envs, seeds",
    "algos: [maddpg, maddpg]": "maddpg HardSpread-v0 plain seed 0 is there twice: name no algorithm",
    "envs: [HardSpred-v0]": 'maddpg HardSpred-v0 plain: unknown environment "HardSpred-v0"; did you mean "HardSpread-v0"?',
    "seeds: [0, -1]": "seeds is [0, -1]; it must be a number of seeds, or a list of seeds from 0 on",
    "seeds: some": "key of a sweep seeds is 'some'; it must be a whole number or a list of whole numbers",
    "settings: {plain: {gama: 1}}": 'unknown hyperparameter "gama"; did you mean "gamma"?',
    "settings: {plain: {gamma: big}}": "hyperparameter gamma is 'big'; it must be a number",
    "settings: {a/b: {}}": 'a setting is called "a/b"; give it a name of letters, digits and . + - _',
    "train: {n-timestep: 5}": 'train: unknown flag of zoo/train.py "n-timestep"; did you mean "n-timesteps"?',
    "train: {seed: 5}": "train: seed is not for the file to give; use seeds",
    "train: {n-timesteps: many}": 'argument -n/--n-timesteps: "many" is no whole number',
    "train: {env-kwargs: {n_agent: 2}}": 'unknown setting of HardSpread-v0 "n_agent"; did you mean "n_agents"?',
    "train: {preset: tunde}": 'unknown preset "tunde"; did you mean "tuned"?',
    "train: {eval-episodes: 0}": "--eval-episodes is 0; it must be at least 1",
    "train: {env-kwargs: {n_agents: 0}}": "maddpg HardSpread-v0 plain: ",  # as the world says it
}


@pytest.mark.parametrize("line", REFUSED)
def test_what_is_wrong_is_said_before_anything_begins(tmp_path, capsys, line):
    file = tmp_path / "wrong.yml"
    good = {
        "algos": "algos: [maddpg]",
        "envs": "envs: [HardSpread-v0]",
        "seeds": "seeds: 1",
        "settings": "settings: {plain: {}}",
    }
    file.write_text("\n".join([*(text for key, text in good.items() if key != line.partition(":")[0]), line]))
    assert sweep.main([str(file), "-f", str(tmp_path / "out"), "--local"]) == 2
    out, error = capsys.readouterr()
    assert error.startswith("error: ") and error.count("\n") == 1 and REFUSED[line] in error
    assert out == "" and not (tmp_path / "out").exists()


def test_the_example_of_the_help_is_a_sweep(tmp_path, capsys):
    file = tmp_path / "example.yml"
    file.write_text(sweep.EXAMPLE)
    assert sweep.main([str(file), "-f", str(tmp_path / "out"), "--dry-run"]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[-1] == "60 runs: 60 to begin, 0 to go on with, 0 done"
    assert out[0] == "begin  maddpg Grassland-v0 as_tuned seed 0, 100,000 env steps"
    assert not (tmp_path / "out").exists()
    with pytest.raises(SystemExit):
        sweep.main(["--help"])
    assert textwrap.indent(sweep.EXAMPLE, "  ") in capsys.readouterr().out
    assert sweep.EXAMPLE in (ROOT / "docs" / "sweeps.md").read_text()


def test_flags_that_cannot_be(tmp_path, capsys):
    file = tiny(tmp_path / "tiny.yml")
    for flags, sentence in {
        ("--workers", "0"): "--workers must be a whole number of at least 1, got 0",
        ("--local", "--address", "auto"): "--local goes without Ray, and --address names a Ray cluster; give one of them",
        ("--worker", "2"): 'unknown flag "--worker"; did you mean "--workers"?',
    }.items():
        assert sweep.main([str(file), *flags]) == 2
        assert capsys.readouterr().err == f"error: {sentence}\n"
    assert sweep.main([str(tmp_path / "none.yml")]) == 2
    assert capsys.readouterr().err == f"error: cannot read {tmp_path / 'none.yml'}: No such file or directory\n"


# ---- one run


def test_a_run_of_a_sweep_is_one_of_train(tmp_path):
    """As a process of the sweep has it, beside the command."""
    (ours,) = read_plan(tiny(tmp_path / "tiny.yml"), tmp_path / "ours")
    (plain,) = read_plan(tiny(tmp_path / "tiny.yml"), tmp_path / "plain")
    assert sweep_run.main(ours.words) == 0
    assert train.main(plain.words) == 0
    one, other = folder_of(ours), folder_of(plain)
    a, b = (MADDPG.load(folder.last_model).get_parameters() for folder in (one, other))
    assert a.keys() == b.keys()
    np.testing.assert_equal(flat(a), flat(b))
    assert episodes(one.monitor_file) == episodes(other.monitor_file)
    assert_equal_arrays(one.path / "evaluations.npz", other.path / "evaluations.npz")
    assert series(one.path) == series(other.path)
    assert find_runs([str(tmp_path / "ours")])[0].folder == one


def flat(value, path=""):
    """Every array of nested containers, by its path."""
    if isinstance(value, dict):
        return {name: array for key, item in value.items() for name, array in flat(item, f"{path}/{key}").items()}
    return {path: np.asarray(value)} if hasattr(value, "shape") else {}


def test_a_run_begins_goes_on_and_is_never_done_twice(tmp_path, monkeypatch):
    begun, given = [], tiny(tmp_path / "tiny.yml")
    (run,), (undisturbed,) = read_plan(given, tmp_path / "a"), read_plan(given, tmp_path / "b")
    original = train.main

    def killed(words, callbacks):
        """Leaves what a process leaves that is killed after some steps."""
        begun.append(words)

        class Kill(sweep_run.Progress):
            def _on_step(self):
                if self.num_timesteps == 120 and len(begun) == 1:
                    raise RuntimeError
                return super()._on_step()

        return original(words, [*callbacks, Kill(tmp_path / "other.json")])

    monkeypatch.setattr(train, "main", killed)
    with pytest.raises(RuntimeError):
        sweep_run.main(run.words)
    assert not run.place.run().has_ended
    assert sweep_run.main(run.words) == 0
    assert begun[1][:2] == ["--resume", str(folder_of(run).path)]
    before = folder_of(run).last_model.stat().st_mtime_ns
    assert sweep_run.main(run.words) == 0
    assert len(begun) == 2 and folder_of(run).last_model.stat().st_mtime_ns == before

    assert sweep_run.main(undisturbed.words) == 0
    one, other = folder_of(run), folder_of(undisturbed)
    assert_equal_runs(one, other)


# ---- workers: programs that take no time to start


PROGRAM = """
import os, signal, sys, time
sys.path.insert(0, {root!r})
from zoo.workers import end_with_parent

def save(*_):
    time.sleep(0.3)
    open({folder!r} + "/saved", "a").write(name)
    sys.exit(7)

name, what = sys.argv[1:]
signal.signal(signal.SIGTERM, save)
end_with_parent()
print("started", name, os.getpid(), flush=True)
if what == "die":
    os.kill(os.getpid(), signal.SIGKILL)
if what == "wait":
    time.sleep(60)
sys.exit(int(what))
"""


@pytest.fixture
def task(tmp_path):
    """Makes tasks of a program that ends as it is told to."""
    program = tmp_path / "program.py"
    program.write_text(PROGRAM.format(root=str(ROOT), folder=str(tmp_path)))

    def make(name, what):
        return Task(name, (str(program), name, what), str(tmp_path / f"{name}.log"), str(tmp_path))

    return make


def all_ended(some, seconds=30):
    """Every task's status, by its name, in the order in which they end."""
    until, statuses = time.monotonic() + seconds, {}
    while not some.idle and time.monotonic() < until:
        statuses.update({task.name: status for task, status in some.ended(1)})
    return statuses


def wait_for(condition, seconds=60):
    until = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < until, "it did not come to pass"
        time.sleep(0.05)
    return found


def test_tasks_tell_how_they_ended_and_the_killed_are_started_again(tmp_path, task):
    some = LocalWorkers(2, 1)
    for name, what in (("fine", "0"), ("refused", "2"), ("killed", "die"), ("late", "0")):
        some.submit(task(name, what))
    assert all_ended(some) == {"fine": 0, "refused": 2, "killed": -signal.SIGKILL, "late": 0}
    logs = {name: (tmp_path / f"{name}.log").read_text().count("started") for name in ("fine", "refused", "killed")}
    assert logs == {"fine": 1, "refused": 1, "killed": workers.LIVES}


def test_one_worker_keeps_the_order(tmp_path, task):
    some = LocalWorkers(1, 1)
    for name in "cab":
        some.submit(task(name, "0"))
    assert [*all_ended(some)] == ["c", "a", "b"]


def test_a_stop_lets_what_runs_save_itself_and_begins_nothing_else(tmp_path, task):
    some = LocalWorkers(1, 1)
    some.submit(task("runs", "wait"))
    some.submit(task("waits", "wait"))
    assert some.ended(0) == []
    wait_for(lambda: "started" in (tmp_path / "runs.log").read_text())
    some.stop()
    assert (tmp_path / "saved").read_text() == "runs"
    assert some.idle and not (tmp_path / "waits.log").exists()


def test_nothing_outlives_whoever_started_it(tmp_path, task):
    child = os.fork()
    if child == 0:  # a sweep, or a worker of a cluster
        some = LocalWorkers(1, 1)
        some.submit(task("orphan", "wait"))
        some.ended(60)
        os._exit(1)
    log = tmp_path / "orphan.log"
    pid = int(wait_for(lambda: log.exists() and re.search(r"started orphan (\d+)\n", log.read_text())).group(1))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    wait_for(lambda: (tmp_path / "saved").exists())
    wait_for(lambda: not psutil.pid_exists(pid) or psutil.Process(pid).status() == psutil.STATUS_ZOMBIE)


def test_without_ray_processes_serve_and_a_note_says_so(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)
    made = workers.make_workers(None, None, threads=1)
    assert isinstance(made, LocalWorkers) and made.n_workers == workers.n_cores()
    assert capsys.readouterr().err == (
        'note: clusters need Ray: pip install "sb3-kfcv[cluster]"; the tasks run as processes of this machine\n'
    )
    with pytest.raises(ValueError, match=re.escape('pip install "sb3-kfcv[cluster]"')):
        workers.make_workers("auto", None, threads=1)


# ---- the whole


@pytest.fixture
def kill_when_saved():
    """Kills the process of a run, once, when it has saved a checkpoint; returns what was killed."""
    threads, killed = [], []

    def kill(run):
        def watch():
            def saved():
                return run.place.run() is not None and [*folder_of(run).path.glob("rl_model_*.zip")]

            wait_for(saved)
            pid = yaml.safe_load(run.place.progress.read_text())["pid"]
            os.kill(pid, signal.SIGKILL)
            killed.append(folder_of(run).last_model.exists())

        threads.append(threading.Thread(target=watch))
        threads[-1].start()
        return killed

    yield kill
    for thread in threads:
        thread.join()


def test_a_killed_run_goes_on_a_failing_one_costs_no_other_and_nothing_runs_twice(tmp_path, capsys, kill_when_saved):
    wild = {**SMALL_LEARNER, "learning_rate": 1e30}
    flags = {**TINY["train"], "n-timesteps": 2400, "eval-freq": 400, "save-freq": 400}
    file = tiny(tmp_path / "tiny.yml", settings={"plain": SMALL_LEARNER, "wild": wild}, train=flags)
    folder = tmp_path / "runs"
    fine, failing = read_plan(file, folder)
    killed = kill_when_saved(fine)
    assert sweep.main([str(file), "-f", str(folder), "--local", "--workers", "2"]) == 1
    out, error = capsys.readouterr()
    assert killed == [False]  # in the middle
    assert error.startswith(
        f"error: {failing.name} met a number that is not finite (exit status 3; {failing.place.log}): error: "
    )
    assert out.splitlines()[-2] == f"2 runs, 1 done, 1 failed; they lie in {folder}"
    assert f"{fine.name}: done, 2,400 of 2,400 env steps, evaluation " in out
    assert (folder / "sweep.yml").read_bytes() == file.read_bytes()
    assert fine.place.log.read_text().count("goes on in") == 1

    (undisturbed, _) = read_plan(file, tmp_path / "undisturbed")
    assert sweep_run.main(undisturbed.words) == 0
    assert_equal_runs(folder_of(fine), folder_of(undisturbed))

    # again, without the one that fails, and with another seed: what is done is left alone
    before = folder_of(fine).last_model.stat().st_mtime_ns
    sweep_run.main(read_plan(tiny(tmp_path / "more.yml", seeds=2, train=flags), folder)[1].words)
    capsys.readouterr()
    assert sweep.main([str(tmp_path / "more.yml"), "-f", str(folder), "--local"]) == 0
    out, error = capsys.readouterr()
    left = f"not in {tmp_path / 'more.yml'}, and stay as they are: {folder_of(failing).path}"
    assert error == f"note: of the runs in {folder} some are {left}\n"
    assert out == f"2 runs, 2 done; they lie in {folder}\n"
    assert folder_of(fine).last_model.stat().st_mtime_ns == before


@pytest.mark.expensive
@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stopped_sweep_saves_everything_and_goes_on(tmp_path, capsys, number, status):
    flags = {**TINY["train"], "n-timesteps": 8000, "eval-freq": 1000, "save-freq": 1000}
    file, folder = tiny(tmp_path / "tiny.yml", seeds=2, train=flags), tmp_path / "runs"
    first, second = runs = read_plan(file, folder)

    def stop():
        wait_for(lambda: first.place.run() is not None and [*folder_of(first).path.glob("rl_model_*.zip")])
        os.kill(os.getpid(), number)

    thread = threading.Thread(target=stop)
    thread.start()
    command = [str(file), "-f", str(folder), "--local", "--workers", "1"]
    assert sweep.main(command) == status
    thread.join()
    out = capsys.readouterr().out
    assert re.search(r"2 runs, 1 waiting, 1 stopped; to go on: \S+.*sweep.*--workers 1$", out, re.MULTILINE)
    assert "SIGTERM: the training stops" in first.place.log.read_text() and not second.place.log.exists()

    assert sweep.main(command) == 0
    assert capsys.readouterr().out.endswith(f"2 runs, 2 done; they lie in {folder}\n")
    for run, undisturbed in zip(runs, read_plan(file, tmp_path / "undisturbed"), strict=True):
        assert sweep_run.main(undisturbed.words) == 0
        assert_equal_runs(folder_of(run), folder_of(undisturbed))


def test_a_run_keeps_its_settings(tmp_path, capsys):
    file, folder = tiny(tmp_path / "tiny.yml"), tmp_path / "runs"
    (run,) = read_plan(file, folder)
    assert sweep_run.main(run.words) == 0
    capsys.readouterr()
    for changes, difference in {
        "gamma": ({"settings": {"plain": {**SMALL_LEARNER, "gamma": 0.5}}}, "gamma 0.99, and is now to have 0.5"),
        "steps": ({"train": {**TINY["train"], "n-timesteps": 300}}, "n_timesteps 200, and is now to have 300"),
        "flag": ({"train": {**TINY["train"], "eval-episodes": 3}}, "eval_episodes 2, and is now to have 3"),
    }.values():
        other = tiny(tmp_path / "other.yml", **changes)
        assert sweep.main([str(other), "-f", str(folder), "--local"]) == 2
        assert capsys.readouterr().err == (
            f"error: {folder_of(run).path} was begun with {difference}; a run keeps its settings: give the sweep another "
            "folder with -f, or these settings another name\n"
        )
    same = {"seeds": 1, "train": {**TINY["train"], "verbose": 1}}
    assert sweep.main([str(tiny(tmp_path / "same.yml", **same)), "-f", str(folder), "--threads", "2", "--local"]) == 0


def test_one_sweep_per_folder(tmp_path, capsys):
    file = tiny(tmp_path / "tiny.yml")
    with sweep.locked(tmp_path / "runs"):
        assert sweep.main([str(file), "-f", str(tmp_path / "runs"), "--local"]) == 2
    assert capsys.readouterr().err == f"error: another sweep is at work in {tmp_path / 'runs'}\n"


# ---- the table


def table_of(runs, **console):
    return ProgressTable(runs, Console(width=150, record=True, **console))


def test_the_table_tells_how_far_everything_is(tmp_path):
    file = tiny(tmp_path / "tiny.yml", seeds=3, train={**TINY["train"], "n-timesteps": 1000})
    runs = read_plan(file, tmp_path / "runs")
    for run in runs:
        run.place.progress.parent.mkdir(parents=True)
    sweep_run.note(runs[2].place.progress, steps=10, of=1000, speed=5.0)  # of an earlier day
    table = table_of(runs)
    sweep_run.note(runs[0].place.progress, steps=600, of=1000, speed=50.0)
    sweep_run.note(runs[1].place.progress)
    table.refresh(now=True)
    first, second, third = table.runs.values()
    assert [run.state for run in (first, second, third)] == [RUNNING, RUNNING, WAITING]
    assert first.seconds_left == (1000 - 600) / 50
    assert first.line() == f"{runs[0].name}: running, 600 of 1,000 env steps, 50 per second, 0:00:08 left"
    # 400 + 1000 + 1000 env steps are left, at 50 a second
    assert table.summary() == "3 runs, 1 waiting, 2 running, about 0:00:48 left"
    runs[0].place.progress.write_text("")  # it is just being written anew
    table.ended(runs[0].name, DONE)
    table.ended(runs[1].name, FAILED)
    assert first.steps == 600
    assert table.summary() == "3 runs, 1 done, 1 waiting, 1 failed"
    shown = table.console.export_text()
    assert shown.count("\n") == 4  # a line for each change


def test_a_small_screen_shows_what_runs_and_what_failed(tmp_path):
    runs = read_plan(tiny(tmp_path / "tiny.yml", seeds=20), tmp_path / "runs")
    table = table_of(runs, height=6, force_terminal=True)
    for index, state in ((5, DONE), (7, RUNNING), (9, FAILED)):
        table.runs[runs[index].name].state = state
    console = Console(width=150, record=True)
    console.print(table.render())
    lines = console.export_text().splitlines()
    assert [line.split()[:5] for line in lines[1:3]] == [
        ["plain", "maddpg", "HardSpread-v0", "9", "failed"],
        ["plain", "maddpg", "HardSpread-v0", "7", "running"],
    ]
    assert lines[3] == "and 18 more"
    assert lines[4] == "20 runs, 1 done, 17 waiting, 1 running, 1 failed"


def test_evaluations_are_shown(tmp_path):
    (run,) = read_plan(tiny(tmp_path / "tiny.yml"), tmp_path / "runs")
    assert sweep_run.main(run.words) == 0
    (watched,) = table_of([run]).runs.values()
    with np.load(folder_of(run).path / "evaluations.npz") as arrays:
        assert watched.evaluation == pytest.approx(arrays["results"][-1].mean())
    assert (watched.state, watched.steps, watched.evaluations) == (DONE, 200, 5)
    assert sweep_table.duration(3725.4) == "1:02:05"
    assert isinstance(folder_of(run), RunFolder)
