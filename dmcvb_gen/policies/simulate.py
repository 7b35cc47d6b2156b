"""Simulate episodes of policies in a task: actions, rewards, states and physics, without images.

An episode depends on its index alone, never on which episodes are simulated beside it: physics does not
mix simulations, every random number comes from the episode's own streams, and a policy adds up in a fixed order,
whatever rows lie beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from dmcvb_gen.policies.actor import Policy
from dmcvb_gen.seeding import episode_seed, episode_stream
from dmcvb_gen.tasks.base import EpisodeBatch, EpisodeError, Task


@dataclass(frozen=True)
class Simulation:
    """Episodes without their pictures; rows past an episode's end are zero.

    Attributes:
      episodes: (episode,) indices in the subset.
      state: (episode, row, state) float32; one row more than the longest episode may have steps.
      action: (episode, row, action) float32 in the task's own bounds, zero in the last row.
      reward, discount: (episode, row) float32, likewise.
      physics: (episode, row, physics) float64.
      length: (episode,) int32, transitions.
      terminated: (episode,) bool, ended by the task; the others were cut off, by it or by the time limit.
      seed: (episode,) uint64, label of the episode's streams.
      behaviour: (episode,) int16, index of the policy.
      goal_pair: (episode,) int16, index of the fixed start and goal, -1 if they are random.
    """

    episodes: np.ndarray
    state: np.ndarray
    action: np.ndarray
    reward: np.ndarray
    discount: np.ndarray
    physics: np.ndarray
    length: np.ndarray
    terminated: np.ndarray
    seed: np.ndarray
    behaviour: np.ndarray
    goal_pair: np.ndarray

    @property
    def returns(self) -> np.ndarray:
        """(episode,) float64: sum of the stored rewards."""
        return self.reward.astype(np.float64).sum(axis=1)

    def part(self, places: slice) -> Simulation:
        """Some of the episodes, as views."""
        return Simulation(**{field.name: getattr(self, field.name)[places] for field in fields(self)})

    def arrays(self) -> dict[str, np.ndarray]:
        """By the store's names."""
        return {name: value for name, value in vars(self).items() if name != "episodes"} | {"return": self.returns}


def simulate(
    task: Task,
    policies: Sequence[Policy],
    episodes: Sequence[int],
    seed: int,
    names: tuple[str, ...],
    *,
    deterministic: bool = True,
    goal_pairs: Sequence[tuple] | None = None,
    episodes_per_goal: int | None = None,
    threads: int = 1,
    max_steps: int | None = None,
) -> Simulation:
    """Simulate episodes of a subset.

    Args:
      policies: behaviour policies; episode i takes number i modulo their count.
      episodes: indices of the episodes.
      seed, names: the recipe's seed and the names of the streams (see `seeding`).
      deterministic: mean actions; False draws samples (uniform random actions are always drawn).
      goal_pairs, episodes_per_goal: fixed (start, goal) cells of a maze; episode i takes pair i // episodes_per_goal.
      max_steps: agent steps at which an episode ends, if not the task's time limit.

    Raises:
      EpisodeError: an episode diverged, or a user's own task failed in it.
    """
    chosen, limit = np.asarray(episodes, int), max_steps or task.max_steps
    starts, noise = (
        [episode_stream(seed, names, int(i), name) for i in chosen] for name in ("initial_state", "policy")
    )
    size, rows = len(chosen), limit + 1
    out = Simulation(
        episodes=chosen,
        state=np.zeros((size, rows, task.state_size), np.float32),
        action=np.zeros((size, rows, task.action_size), np.float32),
        reward=np.zeros((size, rows), np.float32),
        discount=np.zeros((size, rows), np.float32),
        physics=np.zeros((size, rows, task.physics_size)),
        length=np.full(size, limit, np.int32),
        terminated=np.zeros(size, bool),
        seed=np.array([episode_seed(seed, names, int(i)) for i in chosen], np.uint64),
        behaviour=(chosen % len(policies)).astype(np.int16),
        goal_pair=np.full(size, -1, np.int16),
    )
    if goal_pairs is not None:
        out.goal_pair[:] = chosen // (episodes_per_goal or 1)
    most = task.most_at_once or max(1, len(chosen))
    for first in range(0, len(chosen), most):
        places = slice(first, first + most)
        part = out.part(places)
        batch = task.batch(len(part.episodes), threads)
        try:
            if goal_pairs is None:
                state = batch.reset(starts[places])
            else:
                state = batch.reset_fixed(starts[places], [goal_pairs[k] for k in part.goal_pair.tolist()])
            with np.errstate(over="ignore"):  # told below
                _step_to_the_end(batch, state, policies, noise[places], deterministic, part)
            _check_finite(task, part)
        except EpisodeError as error:
            raise error.of_episode(int(part.episodes[error.place])) from error
    for policy in policies:
        policy.check()
    return out


def _check_finite(task: Task, made: Simulation) -> None:
    """Raise EpisodeError if a task gave what is no finite number, or none once it is stored as float32."""
    for name in ("state", "reward", "discount"):
        finite = np.isfinite(getattr(made, name)).reshape(*made.reward.shape, -1).all(axis=2)
        for place, step in np.argwhere(~finite).tolist():
            raise EpisodeError(task.id, place, step, f"its {name} is no finite number of float32; make it one")


class Replay(Policy):
    """Gives the actions of a stored episode again, one a call."""

    unit = False

    def __init__(self, actions: np.ndarray):
        self._left = iter(actions)

    def act(self, observation, generators=None, deterministic=False):
        return next(self._left)[None]


def replay(task: Task, actions: np.ndarray, episode: int, seed: int, names: tuple[str, ...]) -> Simulation:
    """An episode simulated again from its streams and its stored actions; see `simulate`.

    Args:
      actions: (step, action) float32.
    """
    return simulate(task, [Replay(actions)], [episode], seed, names, max_steps=len(actions))


def _step_to_the_end(
    batch: EpisodeBatch,
    state: np.ndarray,
    policies: Sequence[Policy],
    noise: Sequence[np.random.Generator],
    deterministic: bool,
    out: Simulation,
) -> None:
    """Step episodes that have just started until all have ended, and put what happens into `out`.

    Args:
      state: (size, state) of the first observations.
      noise: one generator an episode, of its drawn actions.
    """
    limit = out.state.shape[1] - 1
    active = np.ones(len(state), bool)
    over = np.zeros(len(state), bool)
    actions = np.zeros((len(state), batch.task.action_size), np.float32)
    for step in range(limit + 1):
        out.state[active, step] = state[active]
        out.physics[active, step] = batch.physics()[active]
        active &= ~over
        if step == limit or not active.any():
            break
        seen = batch.behaviour_observation()
        for index, policy in enumerate(policies):
            rows = np.flatnonzero(active & (out.behaviour == index))
            held = max(1, (policy.acts_every or 1) // batch.task.action_repeat)
            if len(rows) and step % held == 0:  # else a policy of a larger action repeat keeps its last actions
                given = policy.act(seen[rows], [noise[row] for row in rows.tolist()], deterministic)
                actions[rows] = batch.task.from_unit(given) if policy.unit else given
        result = batch.step(actions, active)
        state, over = result.state, result.terminated | result.truncated
        out.action[active, step] = actions[active]
        out.reward[active, step] = result.reward[active]
        out.discount[active, step] = result.discount[active]
        out.terminated[result.terminated] = True
        out.length[over] = step + 1
