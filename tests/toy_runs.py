"""Run folders as zoo/train.py leaves them, with numbers of the test's own in their evaluations and logs."""

import numpy as np
from stable_baselines3.common.logger import configure

from zoo.run_folder import RunFolder


def toy_run(
    logs,
    algo="maddpg",
    env="Grassland-v0",
    seed=0,
    steps=(100, 200),
    reward=((0.0, 0.0), (1.0, 1.0)),
    episodes=(),
    scalars=None,
    config=None,
    args=None,
    **metrics,
):
    """
    :param logs: the log folder
    :param steps: env steps of the evaluations; none without any
    :param reward: of each evaluation, of each episode; further metrics likewise
    :param episodes: length and clock of each training episode
    :param scalars: TensorBoard tag → env steps → value
    :param config: settings beside those of every toy run
    :param args: flags beside those of every toy run
    :return: the folder
    """
    folder = RunFolder.create(logs, algo, env)
    settings = {"n_timesteps": 200, "gamma": 0.95, "policy_kwargs": {"n_critics": 1}, **(config or {})}
    folder.describe(settings, {"algo": algo, "env": env, "seed": seed, "n_timesteps": 200, **(args or {})}, "train.py")
    if len(steps):
        lengths = np.full(np.shape(reward), 25)
        arrays = {name: np.array(values, dtype=float) for name, values in metrics.items()}
        np.savez(folder.path / "evaluations.npz", timesteps=np.array(steps), results=reward, ep_lengths=lengths, **arrays)
    lines = ['#{"t_start": 0.0}', "r,l,t", *(f"0.0,{length},{clock}" for length, clock in episodes)]
    folder.monitor_file.write_text("\n".join(lines) + "\n")
    if scalars:
        logger = configure(str(folder.path), ["tensorboard"])
        for tag, values in scalars.items():
            for step, value in values.items():
                logger.record(tag, value)
                logger.dump(step)
        logger.close()
    return folder.path
