"""The entries of mpe2's worlds: do they train, with both kinds of actions, and what does their benchmark measure?"""

import importlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch as th

from sb3_kfcv import ALGOS, make_vec_env
from sb3_kfcv.vec_env.make import layout_of
from zoo import train
from zoo.hyperparams import check, load_entry

pytest.importorskip("mpe2")

WORLDS = [
    f"mpe2/{name}"
    for name in (
        "simple_spread_v3",
        "simple_tag_v3",
        "simple_adversary_v3",
        "simple_speaker_listener_v4",
        "simple_reference_v3",
    )
]
QUICK = ["learning_starts:16", "batch_size:8"]


@pytest.fixture
def curves(monkeypatch):
    """The benchmark, as a script sees it."""
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[1] / "benchmarks"))
    return importlib.import_module("mpe2_curves")


@pytest.mark.parametrize("algo", ALGOS)
@pytest.mark.parametrize("world", WORLDS)
def test_entries_are_valid_and_their_defaults_those_of_table_1(world, algo):
    settings = check(algo, world, load_entry(algo, world))
    table_1 = {"gamma": 0.99, "learning_rate": 1e-3, "buffer_size": 5000, "batch_size": 128, "tau": 0.01}
    assert {name: settings.model[name] for name in table_1} == table_1
    assert (settings.model["exploration_noise"], settings.model["policy_kwargs"]) == (0.1, {"net_arch": [64, 64]})
    tuned = check(algo, world, load_entry(algo, world, preset="tuned"))
    assert check(algo, world, tuned.to_dict()) == tuned != settings


@pytest.mark.parametrize("world", WORLDS)
def test_all_algorithms_are_tuned_alike(world):
    """Those that come with the algorithm itself apart, all get the same settings: what differs between them is the replay."""
    entries = [load_entry(algo, world, preset="tuned") for algo in ALGOS]
    for entry in entries:
        entry.pop("replay_buffer_kwargs", None)
    assert entries[0] == entries[1] == entries[2]


@pytest.mark.filterwarnings("ignore:the curriculum's share of training was over")
@pytest.mark.parametrize(
    ("algo", "world", "continuous"),
    [
        *(("maddpg", world, continuous) for world in WORLDS for continuous in (True, False)),
        ("per_maddpg", WORLDS[0], True),
        ("kfcv_maddpg", WORLDS[0], True),
    ],
)
def test_tuned_entries_train(tmp_path, algo, world, continuous):
    words = ["--algo", algo, "--env", world, "--preset", "tuned", "--seed", "1", "-n", "48", "-f", str(tmp_path)]
    words += ["--env-kwargs", f"continuous_actions:{continuous}", "max_cycles:5", "-params", *QUICK]
    words += ["--eval-freq", "-1", "--save-freq", "-1", "-tb", "", "--verbose", "0"]
    training = train.build(train.make_parser().parse_all(words))
    before = [tensor.clone() for tensor in training.model.actor.parameters()]
    training.model.learn(training.n_timesteps, log_interval=None)
    changed = [not th.equal(old, new) for old, new in zip(before, training.model.actor.parameters(), strict=True)]
    assert all(changed)
    assert training.model.layout.discrete is not continuous


@pytest.mark.filterwarnings("ignore:the state of .* cannot be read")
def test_a_task_is_trained_measured_and_not_again(curves, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(curves, "CURVE_EPISODES", 2)
    monkeypatch.setattr(curves, "FINAL_EPISODES", 4)
    monkeypatch.setattr(curves, "N_EVAL_ENVS", 2)
    output = tmp_path / "curves.json"
    share = 480 / curves.steps_of(curves.TASKS["adversary"])
    words = ["--tasks", "adversary", "--seeds", "2", "--share", str(share), "--output", str(output), "--images", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["mpe2_curves.py", *words])
    curves.main()
    runs = json.loads(output.read_text())["runs"]
    assert [(run["algo"], run.get("seed")) for run in runs] == [("random", None), ("maddpg", 0), ("maddpg", 1)]
    assert runs[1]["curve_steps"] == [80 * i for i in range(7)]
    assert set(runs[1]["final"]) == {
        "adversary learnt, agent random",
        "adversary random, agent learnt",
        "adversary learnt, agent learnt",
    }
    assert "| simple_adversary_v3 | adversary | agent random |" in capsys.readouterr().out
    assert (tmp_path / "mpe2_rivals.png").stat().st_size > 10_000
    written = output.read_bytes()
    curves.main()
    assert output.read_bytes() == written


def xuance_file(layout, shared):
    """As ``train_xuance.py`` writes it, of networks made here; and what these do."""
    th.manual_seed(0)
    names = layout.agents[:1] if shared else layout.agents
    numbers = layout.n_agents if shared else 0
    networks = {
        name: th.nn.Sequential(
            th.nn.Linear(18 + numbers, 7), th.nn.LeakyReLU(), th.nn.Linear(7, 6), th.nn.LeakyReLU(), th.nn.Linear(6, 5)
        )
        for name in names
    }
    arrays = {"seconds": np.array(2.0), "processor_seconds": np.array(1.0)}
    for steps in (0, 10):
        for name, network in networks.items():
            arrays |= {f"{steps}/{name}/{key}": tensor.numpy() for key, tensor in network.state_dict().items()}
    for i, name in enumerate(layout.agents):
        seen = th.randn(4, 18)
        number = th.eye(layout.n_agents)[i].expand(4, -1)
        network = networks[names[0] if shared else name]
        with th.no_grad():
            acted = th.sigmoid(network(th.cat([seen, number], 1) if shared else seen))
        arrays |= {f"observations/{name}": seen.numpy(), f"actions/{name}": acted.numpy()}
    return arrays


@pytest.mark.parametrize("shared", [True, False])
def test_the_peers_actors_act_here_as_they_do_there(curves, shared):
    layout = layout_of(make_vec_env("mpe2/simple_spread_v3", env_kwargs={"continuous_actions": True}))
    arrays = xuance_file(layout, shared)
    trained = curves.peer_players(layout, arrays)
    assert (list(trained.players), trained.seconds, trained.processor_seconds) == ([0, 10], 2.0, 1.0)
    rows = np.hstack([arrays[f"observations/{name}"] for name in layout.agents])
    wanted = np.hstack([arrays[f"actions/{name}"] for name in layout.agents])
    np.testing.assert_allclose(trained.players[10].predict(rows)[0], wanted, atol=1e-5)


def test_actors_of_the_peer_that_act_otherwise_here_are_refused(curves):
    layout = layout_of(make_vec_env("mpe2/simple_spread_v3", env_kwargs={"continuous_actions": True}))
    arrays = xuance_file(layout, shared=True)
    arrays["actions/agent_1"] += 0.1
    with pytest.raises(ValueError, match="agent_1 of XuanCe does"):
        curves.peer_players(layout, arrays)


def test_silent_agents_push_towards_the_middle_of_the_landmarks(curves):
    """
    Landmarks around (0.25, −1), velocity (0.2, 0): twice the way less the velocity is (0.3, −2), of which 1 is the most.
    mpe2's forces are none, left, right, down, up. The speaker says nothing.
    """
    layout = layout_of(make_vec_env("mpe2/simple_speaker_listener_v4", env_kwargs={"continuous_actions": True}))
    assert layout.agents == ("speaker_0", "listener_0")
    row = [1, 0, 0, 0.2, 0, 0.25, -1, 0, -2, 0.5, 0, 0.5, 0.5, 0.5]
    actions, _ = curves.Silent(layout).predict(np.array([row], np.float32))
    np.testing.assert_allclose(actions, [[0, 0, 0, 0, 0, 0.3, 1, 0]], atol=1e-6)


def test_the_table_has_means_over_seeds_with_their_intervals(curves):
    """Student's t of 2 degrees of freedom is 4.303: returns −10, −12, −14 have the half-width 4.303 · 2 / √3 = 4.97."""
    learnt = [
        {
            "task": "reference",
            "algo": "maddpg",
            "seed": seed,
            "final": {"agent learnt": {"return_agent": value}},
        }
        for seed, value in enumerate([-10.0, -12.0, -14.0])
    ]
    random = {"task": "reference", "algo": "random", "episodes": {"return_agent": [-20.0, -30.0]}}
    lines = curves.table(curves.Results([random, *learnt])).splitlines()
    assert lines[2:] == ["| simple_reference_v3 | agent |  | -12.00 ± 4.97 | -25.00 ± 63.53 | MADDPG | 3 |"]


def test_rivals_are_compared_with_random_ones_against_the_same_others(curves):
    """
    Agents get 5 and 7 against learnt adversaries, random ones −3 and −1: 6 ± 12.71 and −2 ± 12.71 (t of 1 degree of freedom is
    12.71, and the standard error 1).
    """
    returns = {
        "adversary learnt, agent random": [(1.0, -3.0), (1.0, -1.0)],
        "adversary random, agent learnt": [(0.0, 9.0), (0.0, 9.0)],
        "adversary learnt, agent learnt": [(2.0, 5.0), (2.0, 7.0)],
    }
    runs = [
        {
            **{"task": "tag", "algo": "maddpg", "seed": seed},
            "final": {
                line_up: dict(zip(("return_adversary", "return_agent"), pairs[seed], strict=True))
                for line_up, pairs in returns.items()
            },
        }
        for seed in range(2)
    ]
    random = {"task": "tag", "algo": "random", "episodes": {"return_adversary": [0.0, 0.0], "return_agent": [0.0, 2.0]}}
    assert curves.table(curves.Results([random, *runs])).splitlines()[2:] == [
        "| simple_tag_v3 | adversary | agent random | 1.00 ± 0.00 | 0.00 ± 0.00 | MADDPG | 2 |",
        "| simple_tag_v3 | adversary | agent learnt | 2.00 ± 0.00 | 0.00 ± 0.00 | MADDPG | 2 |",
        "| simple_tag_v3 | agent | adversary random | 9.00 ± 0.00 | 1.00 ± 12.71 | MADDPG | 2 |",
        "| simple_tag_v3 | agent | adversary learnt | 6.00 ± 12.71 | -2.00 ± 12.71 | MADDPG | 2 |",
    ]
