"""
JaxMARL: its MPE scenarios by ``jaxmarl.make``, batched with ``jax.vmap`` and compiled with ``jax.jit``, as its documentation
shows, with continuous actions (of 5, as in mpe2). Two ways are timed and the quicker one is told: a ``lax.scan`` over many
steps in one call (what a learner inside JAX uses) and one call per step (what a learner outside needs).
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from protocol import EPISODE_STEPS, SPREAD_AGENTS, TAG_SHEEP, TAG_WOLVES, Work, cases, main, seconds_per_operation

SCENARIOS: dict[str, tuple[str, dict[str, int], str]] = {
    "spread": (
        "MPE_simple_spread_v3",
        {"num_agents": SPREAD_AGENTS, "num_landmarks": SPREAD_AGENTS},
        "actions of 5, auto-reset",
    ),
    "tag": (
        "MPE_simple_tag_v3",
        {"num_good_agents": TAG_SHEEP, "num_adversaries": TAG_WOLVES, "num_obs": 2},
        "simple_tag, observations 62–64 (most velocities are left out); actions of 5, auto-reset; no food, nobody dies",
    ),
}


def simulate(scenario: str, n_worlds: int) -> Work:
    os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    import jax
    import jaxmarl

    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_compilation_cache_dir", str(Path(__file__).resolve().parents[2] / ".peers" / "jaxmarl" / "cache"))
    name, settings, note = SCENARIOS[scenario]
    env = jaxmarl.make(name, action_type="Continuous", max_steps=EPISODE_STEPS, **settings)
    key = jax.random.PRNGKey(0)
    n_steps = EPISODE_STEPS if n_worlds <= 1024 else 5  # of a call; every step starts anew what is over
    actions = {
        agent: jax.random.uniform(jax.random.fold_in(key, i), (n_steps, n_worlds, 5)) for i, agent in enumerate(env.agents)
    }
    observations, states = jax.vmap(env.reset)(jax.random.split(key, n_worlds))
    rewards = {agent: jax.numpy.zeros(n_worlds) for agent in env.agents}

    def step(key: Any, states: Any, actions: Any) -> Any:
        key, own = jax.random.split(key)
        observations, states, rewards, _, _ = jax.vmap(env.step)(jax.random.split(own, n_worlds), states, actions)
        return key, observations, states, {agent: rewards[agent].astype("float32") for agent in env.agents}

    @jax.jit
    def scan(carry: Any) -> Any:
        return jax.lax.scan(lambda carry, chosen: (step(carry[0], carry[2], chosen), None), carry, actions)[0]

    per_step = [{agent: actions[agent][t] for agent in env.agents} for t in range(n_steps)]
    one_step = jax.jit(step)

    class Ways:
        carry = (key, observations, states, rewards)

        def by_scan(self) -> None:
            self.carry = scan(self.carry)
            jax.block_until_ready(self.carry)

        def by_call(self) -> None:
            for chosen in per_step:
                self.carry = one_step(self.carry[0], self.carry[2], chosen)
            jax.block_until_ready(self.carry)

    ways: dict[str, Callable[[], None]] = {"scanned": Ways().by_scan, "one call per step": Ways().by_call}
    works = {way: Work(run, n_steps * n_worlds, f"{note}; {way}") for way, run in ways.items()}
    seconds = {way: min(seconds_per_operation(work, 2, 0.05)) for way, work in works.items()}
    return works[min(seconds, key=seconds.__getitem__)]


if __name__ == "__main__":
    main(
        ["jaxmarl", "jax", "numpy"],
        cases(spread=partial(simulate, "spread"), tag=partial(simulate, "tag")),
    )
