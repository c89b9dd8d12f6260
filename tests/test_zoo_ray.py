"""Sweeps on a Ray cluster of several machines, all of them on this one: what is killed goes on elsewhere, to the same bits."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
import yaml
from test_resume import assert_equal_runs
from test_zoo import ROOT
from test_zoo_sweep import (  # noqa: F401  (task is a fixture)
    SMALL_LEARNER,
    TINY,
    all_ended,
    folder_of,
    task,
    tiny,
    wait_for,
)

from zoo import sweep_run, workers
from zoo.sweep_plan import read_plan

ray = pytest.importorskip("ray")

pytestmark = pytest.mark.expensive

MEMORY = 80 << 20  # bytes of each machine's object store: Ray's least
ENVIRONMENT = {**os.environ, "RAY_USAGE_STATS_ENABLED": "0", "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}


@pytest.fixture
def cluster(monkeypatch):
    """A head that runs nothing, and two machines of one core each."""
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    from ray.cluster_utils import Cluster

    head = {"num_cpus": 0, "include_dashboard": False, "object_store_memory": MEMORY}
    made = Cluster(initialize_head=True, head_node_args=head)
    try:
        for _ in range(2):
            made.add_node(num_cpus=1, object_store_memory=MEMORY)
        yield made
    finally:
        made.shutdown()


@pytest.fixture
def ray_workers():
    made = []

    def make(n_workers):
        made.append(workers.RayWorkers(None, n_workers, 1))
        return made[-1]

    yield make
    for some in made:
        some.close()


def test_ray_tells_how_tasks_ended_and_carries_on_when_its_worker_dies(tmp_path, task, ray_workers):  # noqa: F811
    some = ray_workers(1)
    for name, what in (("fine", "0"), ("refused", "2"), ("killed", "die"), ("long", "wait")):
        some.submit(task(name, what))
    statuses = {}
    while len(statuses) < 3:
        statuses.update({ended.name: status for ended, status in some.ended(1)})
    assert statuses == {"fine": 0, "refused": 2, "killed": -signal.SIGKILL}
    assert [*statuses] == ["fine", "refused", "killed"]

    some.ended(0)
    log = tmp_path / "long.log"
    started = wait_for(lambda: log.exists() and re.findall(r"started long (\d+)\n", log.read_text()))
    psutil.Process(int(started[0])).parent().kill()  # Ray's worker: its program saves itself, and begins anew elsewhere
    wait_for(lambda: len(re.findall("started long", log.read_text())) == 2)
    assert (tmp_path / "saved").read_text() == "long"

    some.stop()
    assert (tmp_path / "saved").read_text() == "longlong"
    assert some.idle


def test_a_stop_is_heard_where_ctrl_c_is_ignored(tmp_path, task, ray_workers):  # noqa: F811
    """A script's commands in the background ignore SIGINT, and so does all that they start."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        some = ray_workers(1)
    finally:
        signal.signal(signal.SIGINT, before)
    some.submit(task("runs", "wait"))
    some.ended(0)
    wait_for(lambda: (tmp_path / "runs.log").exists() and "started" in (tmp_path / "runs.log").read_text())
    some.stop()
    assert (tmp_path / "saved").read_text() == "runs"


def test_a_machine_that_does_not_see_the_sweep_is_named(tmp_path, task, monkeypatch):  # noqa: F811
    monkeypatch.setattr(workers, "PATIENCE", 0.2)
    hidden = workers.Task("hidden", task("a", "0").words, str(tmp_path / "log"), str(tmp_path), (str(tmp_path / "sweep.yml"),))
    said = workers.carry_out(hidden, 1)
    assert isinstance(said, str) and f" does not see {tmp_path / 'sweep.yml'}: all machines must find" in said
    assert not (tmp_path / "log").exists()


def test_without_a_cluster_a_sentence_says_so(tmp_path):
    for address in ("127.0.0.1:1", "127.0.0.1:port", "auto"):
        done = sweep_process(tiny(tmp_path / "tiny.yml"), tmp_path / "runs", address).communicate(timeout=120)[0]
        assert re.search(rf"^error: no Ray cluster answers at {address}, or it wants another token: .+$", done, re.MULTILINE)
        assert "Traceback" not in done


def sweep_process(file, folder, address):
    words = [sys.executable, "zoo/sweep.py", str(file), "-f", str(folder), "--address", address]
    return subprocess.Popen(words, cwd=ROOT, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def trainings(folder):
    """The processes that train in a sweep."""
    found = {}
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            words = process.cmdline()
            if "sweep_run.py" in " ".join(words[:2]) and str(folder) in words[-1]:
                found[words[-1], words[words.index("--algo") + 1]] = process
    return found


def machine_of(process, nodes):
    """Which machine of the cluster a process runs on, by the processes above it."""
    above = {parent.pid for parent in process.parents()}
    return next(
        node for node in nodes if {info.process.pid for infos in node.all_processes.values() for info in infos} & above
    )


def has_saved(run):
    begun = run.place.run()
    return begun is not None and not begun.has_ended and [*begun.folder.path.glob("rl_model_*.zip")]


def test_a_sweep_whose_machine_dies_equals_an_undisturbed_one(tmp_path, cluster):
    flags = {**TINY["train"], "n-timesteps": 12_000, "eval-freq": 1000, "save-freq": 1000}
    settings = {"plain": {**SMALL_LEARNER, "replay_buffer_kwargs": {}}}
    file = tiny(tmp_path / "sweep.yml", algos=["maddpg", "kfcv_maddpg"], seeds=2, settings=settings, train=flags)
    folder = tmp_path / "runs"
    runs = read_plan(file, folder)

    # the sweep itself is killed: nothing goes on without it
    first = sweep_process(file, folder, cluster.address)
    wait_for(lambda: any(map(has_saved, runs)), 180)
    first.kill()
    first.wait()
    wait_for(lambda: not trainings(folder))
    assert any(map(has_saved, runs))

    # a machine is killed; another one joins
    second = sweep_process(file, folder, cluster.address)
    nodes = [node for node in cluster.list_all_nodes() if node is not cluster.head_node]
    begun = [run for run in runs if has_saved(run)]
    notes = {run.name: run.place.progress.read_text() for run in begun}
    wait_for(lambda: any(run.place.progress.read_text() != notes[run.name] for run in begun), 180)
    time.sleep(3)  # into the training
    victim = machine_of(next(iter(trainings(folder).values())), nodes)
    cluster.remove_node(victim, allow_graceful=False)
    assert second.poll() is None  # in the middle
    cluster.add_node(num_cpus=1, object_store_memory=MEMORY)

    # and a process
    process = wait_for(lambda: [*trainings(folder).values()], 180)[-1]
    time.sleep(3)
    with contextlib.suppress(psutil.NoSuchProcess):
        process.kill()
    out = second.communicate(timeout=600)[0]
    assert second.returncode == 0, out
    assert out.splitlines()[-1] == f"4 runs, 4 done; they lie in {folder}"

    models = {run.name: folder_of(run).last_model.stat().st_mtime_ns for run in runs}
    again = sweep_process(file, folder, cluster.address)
    assert again.communicate()[0].splitlines()[-1] == f"4 runs, 4 done; they lie in {folder}"
    assert {run.name: folder_of(run).last_model.stat().st_mtime_ns for run in runs} == models

    logs = "".join(run.place.log.read_text() for run in runs)
    assert logs.count("goes on in") >= 2
    for run, undisturbed in zip(runs, read_plan(file, tmp_path / "undisturbed"), strict=True):
        assert sweep_run.main(undisturbed.words) == 0
        assert yaml.safe_load(run.place.progress.read_text())["steps"] == 12_000
        assert len([*Path(run.place.log_folder, run.algo).glob("HardSpread-v0_*")]) == 1
        assert_equal_runs(folder_of(run), folder_of(undisturbed))


def test_a_search_on_a_cluster(tmp_path, cluster):
    """The machines of a cluster try the trials of zoo/optimize.py."""
    words = ["--algo", "maddpg", "--env", "HardSpread-v0", "--env-kwargs", "n_agents:2", "max_steps:5", "-n", "60"]
    words += [
        "-params",
        "n_envs:2",
        "learning_starts:10",
        "--n-trials",
        "4",
        "--n-startup-trials",
        "2",
        "--eval-episodes",
        "2",
    ]
    words += ["--n-jobs", "2", "--address", cluster.address, "-o", str(tmp_path / "search")]
    done = subprocess.run(
        [sys.executable, "zoo/optimize.py", *words], cwd=ROOT, env=ENVIRONMENT, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert len(json.loads((tmp_path / "search" / "trials.json").read_text())["trials"]) == 4
    assert (tmp_path / "search" / "best.yml").is_file()
