"""What a team meets while another one learns beside it: the other as it is now, and as it once was."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th

from sb3_kfcv.common.actors import ActorPolicy
from sb3_kfcv.common.checks import require_between, require_count
from sb3_kfcv.common.naming import unknown_name
from sb3_kfcv.maddpg import MADDPG
from sb3_kfcv.teams.players import Mixture, written

SAMPLINGS = ("uniform", "win_rate")


class CoLearner:
    """
    A team that learns beside ours. It plays by its actors as they are; a critic expects of it what its target actors do, as
    eq. 5 has it for all agents.
    """

    model: MADDPG

    @property
    def policy(self) -> ActorPolicy:
        """Its actors as they are now."""
        return self.model.policy

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[np.ndarray, None]:
        """Joint actions of joint rows; only its own columns mean something."""
        return self.model.policy.predict(observation, deterministic=deterministic)[0], None

    def greedy_rows(self, observations: th.Tensor) -> th.Tensor:
        """Its target actors' actions a'_j = π'_j(o'_j), as a critic sees them (batch, joint action)."""
        return self.model.policy.joint_actions(self.model.actor_target, observations, learning=True)


class Pool(Mixture):
    """
    A team as it is now and as it once was: fictitious self-play keeps the others from learning to beat its latest whim alone.

    :param learner: the team as it is now
    :param share: of the episodes that its past selves play, in [0, 1]
    :param size: past selves kept: an even sample of all that were ever offered (reservoir sampling, Vitter 1985, as in neural
        fictitious self-play)
    :param rng: draws what a full pool keeps
    :param sampling: ``"uniform"``, or ``"win_rate"``: in proportion to how often a past self has won, so that those that are
        hard to beat come more often (one game won and one lost are counted for each beforehand)
    :raises ValueError: for settings out of their range
    """

    def __init__(
        self, learner: CoLearner, rng: np.random.Generator, share: float = 0.0, size: int = 20, sampling: str = "uniform"
    ) -> None:
        require_between("pool_share", share, 0, 1)
        require_count("pool_size", size)
        if sampling not in SAMPLINGS:
            raise ValueError(unknown_name("pool_sampling", sampling, SAMPLINGS))
        super().__init__([learner])
        self.rng, self.share, self.size, self.sampling = rng, share, size, sampling
        self.offered = 0
        self.games = np.zeros(0)  # of each past self
        self.won = np.zeros(0)  # of these

    def offer(self) -> None:
        """Take the team up as it is now; a full pool takes it in place of another one, or not at all."""
        self.offered += 1
        past = written(self.players[0])
        if len(self.games) < self.size:
            self.players.append(past)
            self.games, self.won = np.append(self.games, 0.0), np.append(self.won, 0.0)
        elif (place := int(self.rng.integers(self.offered))) < self.size:
            self.players[1 + place] = past
            self.games[place] = self.won[place] = 0
        self._weigh()

    def _weigh(self) -> None:
        if len(self.games) == 0:
            self.weights = np.ones(1)
            return
        wanted = (self.won + 1) / (self.games + 2) if self.sampling == "win_rate" else np.ones(len(self.games))
        self.weights = np.append(1 - self.share, self.share * wanted / wanted.sum())

    def note_results(self, playing: np.ndarray, won: np.ndarray) -> None:
        """
        Hear of episodes that ended.

        :param playing: who played: 0 the learner, i past self i (episodes,)
        :param won: how far the team won, in [0, 1] (episodes,)
        """
        past = playing > 0
        np.add.at(self.games, playing[past] - 1, 1)
        np.add.at(self.won, playing[past] - 1, won[past])
        self._weigh()

    def get_state(self) -> dict[str, Any]:
        """The past selves, their record, and the random generator."""
        record = {"offered": self.offered, "games": self.games.copy(), "won": self.won.copy()}
        return {"past": self.players[1:], "rng": self.rng.bit_generator.state, **record}

    def set_state(self, saved: dict[str, Any]) -> None:
        """
        Inverse of :meth:`get_state`.

        :raises ValueError: if the record is not of these past selves
        """
        past, games, won = saved["past"], saved["games"].copy(), saved["won"].copy()
        now = self.players[0].policy
        if not all(isinstance(one, ActorPolicy) and (one.layout, one.agents) == (now.layout, now.agents) for one in past):
            raise ValueError("the past selves of a pool are actors of the team itself")
        if not (games.shape == won.shape == (len(past),) and (won >= 0).all() and (won <= games).all()):
            raise ValueError(f"a pool of {len(past)} past selves that has played {games} and won {won}")
        require_count("the past selves that a pool was offered", saved["offered"], least=len(past))
        self.offered, self.games, self.won = saved["offered"], games, won
        self.rng.bit_generator.state = saved["rng"]
        self.players = [self.players[0], *saved["past"]]
        self._weigh()
