"""Score a policy on fresh episodes, all in one batch; keep and load policies that `validate` trained.

The episodes are those of a task, painted at the data's size by the data's renderer, with a setting's distractors:
unseen `val` videos and maze styles, and streams of their own, apart from every release's (paper, section 5). In mazes
an agent has 1,000 steps (`Task.evaluation_steps`), where the authors' evaluation stops; the data were cut at 600.

    agent = load_agent("reports/mini/cells/b1_walker-walk_none_state-bc_expert.safetensors")
    dmcvb_gen.evaluate(agent, "walker-walk/none")
"""

from __future__ import annotations

import contextlib
import json
import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from dmcvb_gen.dataset.manifest import MAX_STEPS
from dmcvb_gen.dataset.pictures import NOT_TRAINED_ON, Pictures, shown
from dmcvb_gen.dataset.reader import Subset
from dmcvb_gen.distractors import DistractorSampler
from dmcvb_gen.errors import DmcvbError, first_line
from dmcvb_gen.files import replacing
from dmcvb_gen.generate.inputs import BUILTIN, shown_videos
from dmcvb_gen.generate.recipe import NATIVE
from dmcvb_gen.generate.references import normalized, reference_returns
from dmcvb_gen.generate.render import open_renderer
from dmcvb_gen.generate.request import background_source
from dmcvb_gen.options import Count, Location, Seed, Split, checked, refuse
from dmcvb_gen.policies.evaluation import goal_scores
from dmcvb_gen.seeding import DISTRACTOR_STREAMS, episode_stream
from dmcvb_gen.spec import FIXED, SubsetSpec, parse_setting, task_folder
from dmcvb_gen.tasks import ACTION_REPEAT, Task, get_task

if TYPE_CHECKING:
    from dmcvb_gen.agents.catalog import Agent
    from dmcvb_gen.agents.data import Normalization, Sizes
    from dmcvb_gen.agents.learners import Policy
    from dmcvb_gen.agents.networks import Architecture

_log = logging.getLogger("dmcvb_gen")
Act = Callable[[dict[str, np.ndarray]], Any]
"""A policy of one's own: observations of all episodes in, (episode, action) out, in the task's bounds.

The observations are "pixels" (episode, stack x view x 3, size, size) uint8, oldest frame first, as a release's `source`
gives them, and "state" (episode, state) float32. A policy that asks for no pictures gets the states alone.
"""
STREAM_NAME = "validate"
"""Name of the evaluation's random streams, from which no release is made."""
ROUNDING = 1e-5
"""How far an action may leave its bounds before it is refused: what rounding does."""
SHOTS = 8
"""Frames of the first episode that a score keeps, about."""
SPLIT: Split = "val"
"""Split of the videos and maze styles that no data show."""


@dataclass(frozen=True)
class Score:
    """Returns of episodes: of an evaluation, or of the data that a policy learned from.

    Attributes:
      mean, stderr: mean and standard error of the returns; the standard error is std / sqrt(episodes), std with n - 1,
        and NaN of one episode.
      returns: return of each episode.
      success: share of the episodes that the task ended (mazes), else None.
      speed: mean speed towards the goal of the successful episodes, m/s (mazes), else None (`goal_scores`).
      limit: agent steps after which an episode was cut.
      normalized: the mean, 0 for random actions and 100 for the data's expert; None without data, or if one is unknown.
      pictures: (frame, size, size, 3) uint8, the first episode at even intervals; None for agents that see states.
    """

    mean: float
    stderr: float
    returns: tuple[float, ...]
    success: float | None = None
    speed: float | None = None
    limit: int | None = None
    normalized: float | None = None
    pictures: np.ndarray | None = field(default=None, repr=False)

    @classmethod
    def of(cls, returns: np.ndarray, **others: Any) -> Score:
        """The score of (episode,) returns; `others`: its further attributes."""
        count = len(returns)
        stderr = float(returns.std(ddof=1) / math.sqrt(count)) if count > 1 else math.nan
        return cls(float(returns.mean()), stderr, tuple(float(value) for value in returns), **others)

    def facts(self) -> dict[str, Any]:
        """Everything but the pictures, as plain values; None instead of NaN, which JSON does not have."""
        facts = {name: value for name, value in vars(self).items() if name != "pictures"}
        return facts | {"stderr": None if math.isnan(self.stderr) else self.stderr}


def evaluation_steps(task: Task, max_steps: int | None = None) -> int:
    """Agent steps after which an evaluation's episode is cut, by its task and (for smoke runs) `max_steps`."""
    return min(max_steps or task.evaluation_steps, task.evaluation_steps)


def renderer_choice(subset: Subset) -> dict[str, Any]:
    """Name and samples of the renderer: the data's own, or the default one if the record names none of ours."""
    own = {} if subset.record.imported else subset.record.renderer
    return {"name": own.get("name", NATIVE), "samples": own.get("samples")}


@dataclass(frozen=True)
class EvaluationScene:
    """Task, distractors and pictures of evaluation episodes.

    Attributes:
      task, setting: e.g. "walker-walk", "dynamic"; they name the random streams, too.
      pictures: pictures that the policy sees.
      size: pixels a side.
      renderer, samples: its name; samples a pixel, None for the renderer's default.
      backgrounds: "builtin" or a folder of videos.
      split: "val" shows videos and maze styles that are in no data, "train" those of the data.
      action_repeat: control steps for which an action is held.
    """

    task: str
    setting: str
    pictures: Pictures
    size: int = 64
    renderer: str = NATIVE
    samples: int | None = None
    backgrounds: str = "builtin"
    split: str = SPLIT
    action_repeat: int = ACTION_REPEAT

    @classmethod
    def of(cls, subset: Subset, backgrounds: str | None = None) -> EvaluationScene:
        """Return the scene of a subset; `backgrounds`: the videos' folder, if it is not where the manifest says."""
        record, (renderer, samples) = subset.record, renderer_choice(subset).values()
        source = shown_videos(subset, backgrounds)
        look = (shown(subset, "agents"), record.size, renderer, samples, source)
        return cls(subset.task, subset.setting, *look, action_repeat=record.action_repeat)

    @classmethod
    def parse(cls, where: str, **options: Any) -> EvaluationScene:
        """Return the scene of "walker-walk/dynamic" or "ant-maze-empty7x7/visible"; `options`: size, renderer, ...

        Raises:
          DmcvbError: the text has another form, or there is no such task or setting.
        """
        task, slash, setting = where.rpartition("/")
        if not slash or not setting:
            raise DmcvbError(f"{where!r} names no evaluation; give TASK/SETTING, e.g. walker-walk/dynamic")
        spec = SubsetSpec.parse(task, "random", setting)
        views = [view for view in get_task(task).views if view not in NOT_TRAINED_ON]
        return cls(task, spec.setting, Pictures(tuple(views), spec.hides_goal), **options)


class Evaluator:
    """Evaluates policies on one scene; a renderer is started once and kept.

    Args:
      where: the scene, or a subset whose task, setting, size and renderer are evaluated on.
      pixels: the policies see pictures; else states.
      stack: frames an observation.
      episodes: run side by side, each once.
      seed: seed of the evaluation's streams.
      pair: the fixed (start, goal) cells of a maze's episodes, instead of random ones.
      max_steps: cut episodes short (for tests and smoke runs).
      backgrounds: folder of the `val` videos, if not the manifest's.

    Raises:
      DmcvbError: the renderer cannot start here, or there are no `val` videos.
    """

    def __init__(
        self,
        where: Subset | EvaluationScene,
        *,
        pixels: bool = True,
        stack: int = 3,
        episodes: int = 30,
        seed: int = 0,
        pair: tuple | None = None,
        max_steps: int | None = None,
        backgrounds: str | None = None,
        threads: int = 1,
    ):
        scene = EvaluationScene.of(where, backgrounds) if isinstance(where, Subset) else where
        self.scene, self.task = scene, get_task(scene.task).at(scene.action_repeat)
        self.setting = parse_setting(scene.task, scene.setting)[0]
        self.episodes, self.seed, self.threads = episodes, seed, threads
        self.steps = evaluation_steps(self.task, max_steps)
        self.stack, self.pair, self.renderer, self.videos = stack, pair, None, None
        if pixels:
            look = (scene.renderer, scene.size, scene.samples)
            self.renderer, self.videos = open_renderer(self.task, self.setting, *look, scene.backgrounds, scene.split)

    def close(self) -> None:
        """Free the renderer."""
        if self.renderer is not None:
            self.renderer.close()

    def streams(self, name: str) -> list[np.random.Generator]:
        """The evaluation's own streams; the same for every policy, so that scores are compared on like episodes."""
        names = (STREAM_NAME, self.scene.task, self.scene.setting)
        return [episode_stream(self.seed, names, episode, name) for episode in range(self.episodes)]

    def score(self, act: Act) -> Score:
        """Roll a policy out. It is asked for one action a step, for all episodes at once.

        Raises:
          DmcvbError: its actions have another shape than (episode, action), are no numbers, or leave the task's bounds.
        """
        task, count = self.task, self.episodes
        batch = task.batch(count, self.threads)
        starts = self.streams("initial_state")
        state = batch.reset(starts) if self.pair is None else batch.reset_fixed(starts, [self.pair] * count)
        start = state.copy()
        walk, stack, pictures, action = self._walk(), None, [], None
        returns, length = np.zeros(count), np.full(count, self.steps)
        active, ended = np.ones(count, bool), np.zeros(count, bool)
        for step in range(self.steps):
            observation = {"state": state.astype(np.float32)}
            if walk is not None:
                stack = self._see(stack, batch.physics(), walk, step, active, action)
                if step % max(1, self.steps // SHOTS) == 0:
                    pictures.append(stack[0, -1, :3].transpose(1, 2, 0).copy())
                observation["pixels"] = stack.reshape(count, -1, *stack.shape[3:]).copy()
            given = act(observation)
            given = task.from_unit(given) if isinstance(act, TrainedAgent) else given
            action = check_actions(given, (count, task.action_size), step, task.action_low, task.action_high)
            result = batch.step(action, active)
            state = result.state
            returns += result.reward  # episodes that are over earn nothing
            over = (result.terminated | result.truncated) & active
            length[over] = step + 1
            ended |= result.terminated
            active &= ~over
            if not active.any():
                break
        success, speed = goal_scores(task, start, length, ended)
        shown = np.stack(pictures) if pictures else None
        return Score.of(returns, success=success, speed=speed, limit=self.steps, pictures=shown)

    def _walk(self) -> DistractorSampler | None:
        """The distractors of the episodes; None for policies that see states."""
        if self.renderer is None:
            return None
        generators = {name: self.streams(name) for name in DISTRACTOR_STREAMS}
        return DistractorSampler(self.task, self.setting, self.steps + 1, generators, self.videos, self.scene.split)

    def _see(self, stack, physics, walk: DistractorSampler, step: int, active, action=None) -> np.ndarray:
        """(episode, frame, channel, size, size) uint8 with the newest frame last; only running episodes are painted."""
        rows = np.flatnonzero(active)
        labels = walk.labels(physics, action, step)[rows]
        shown = self.scene.pictures
        painted = self.renderer.render(physics[rows], labels, list(shown.views), hide_goal=shown.hide_goal)
        frames = painted.transpose(0, 1, 4, 2, 3).reshape(len(rows), -1, *painted.shape[2:4])
        if stack is None:
            return np.repeat(frames[:, None], self.stack, axis=1)
        stack[:, :-1] = stack[:, 1:].copy()
        stack[rows, -1] = frames
        return stack


def check_actions(actions: Any, shape: tuple[int, int], step: int, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(episode, action) float32: the actions of a policy at a step.

    Args:
      low, high: (action,) the task's bounds.

    Raises:
      DmcvbError: they have another shape, are no numbers, or leave the bounds.
    """
    if hasattr(actions, "detach"):  # a torch tensor, which numpy does not read if it has a gradient or is elsewhere
        actions = actions.detach().cpu().float()
    try:
        values = np.asarray(actions, np.float32)
    except (TypeError, ValueError) as error:
        raise DmcvbError(f"step {step}: the policy gave no array of actions ({error}); expected {shape}") from None
    if values.shape != shape:
        raise DmcvbError(f"step {step}: the policy gave actions of shape {values.shape}; expected {shape}")
    low, high = np.broadcast_to(low, shape), np.broadcast_to(high, shape)
    inside = (values >= low - ROUNDING) & (values <= high + ROUNDING)
    if not inside.all():
        place = tuple(map(int, np.argwhere(~inside)[0]))
        expected = f"[{low[place]:g}, {high[place]:g}]"
        cure = f"expected {expected}, clip it" if np.isfinite(values[place]) else f"expected numbers in {expected}"
        raise DmcvbError(f"step {step}: the policy's action {place} is {values[place]:g}; {cure}")
    return values.clip(low, high)


@checked
def evaluate(
    policy: Any,
    where: Any,
    *,
    episodes: Count = 30,
    seed: Seed = 0,
    stack: Count | None = None,
    pixels: bool | None = None,
    size: int | None = None,
    renderer: str | None = None,
    samples: int | None = None,
    backgrounds: Location | None = None,
    split: Split = SPLIT,
    action_repeat: Literal[1, 2, 4] | None = None,
    max_steps: Count | None = None,
    threads: Count = 1,
) -> Score:
    """Score a policy of your own by the protocol, starts and videos of `validate`.

    All episodes run side by side, and the policy is asked for the actions of all of them at once. If it has attributes
    `stack`, `pixels` or `picture_size`, those are its own: other values are refused. A policy of `load_agent` has them;
    if it learned another task, from images of another renderer or from other videos than the evaluation's, a warning
    is logged.

    Args:
      policy: takes {"pixels": (episode, stack x view x 3, size, size) uint8, "state": (episode, state) float32} and
        gives (episode, action) in the task's bounds, [-1, 1] for most, as a numpy array or anything that numpy can
        read.
      where: TASK/SETTING: "walker-walk/dynamic", "ant-maze-empty7x7/visible"; or a subset, whose size, renderer, videos
        and time limit are taken.
      episodes: number of episodes, each run once.
      seed: seed of starts and distractors; `validate` has 0. Each setting has starts of its own.
      stack: frames an observation, by default 3; the first one of an episode is repeated.
      pixels: give pictures, by default yes; without them an evaluation takes seconds.
      size: pixels a side, by default 64. renderer: its name. samples: anti-aliasing samples of a pixel. Both are by
        default those of the data that a `load_agent` policy learned from, or the package's.
      backgrounds: "builtin" or a folder of videos, by default the subset's own or else the built-in ones.
      split: videos and maze styles to show: "val", as `validate` does, or "train", those of the data. The difference of
        the two scores is what a policy loses on distractors that it has not seen.
      action_repeat: control steps for which an action is held, by default those of a `load_agent` policy's data, or 2.
      max_steps: cut episodes short; they never last longer than in `validate`.

    Returns:
      A `Score`: mean, stderr and returns; of mazes also success and speed.

    Raises:
      DmcvbError: no such task, setting or split, or actions that have another shape, are no numbers or leave their
        bounds, or observations or actions of another kind or size than the policy's.
    """
    pixels = _own_value(policy, "pixels", pixels, True)
    backgrounds = None if backgrounds is None else background_source(backgrounds)
    shown: dict[str, Any] = dict(stack=stack, size=size, renderer=renderer, samples=samples, backgrounds=backgrounds)
    if not pixels:
        refuse("the policy sees no pictures", **shown)
    stack = _own_value(policy, "stack", stack, 3)
    seen = getattr(policy, "evaluation", None) or {}
    if isinstance(where, Subset):
        scene = EvaluationScene.of(where, backgrounds)
        _own_value(policy, "picture_size", scene.size if pixels and size is None else size, 0)
        longest = where.record.max_steps * where.record.action_repeat // (action_repeat or where.record.action_repeat)
        max_steps = min(max_steps or MAX_STEPS, longest)
    else:
        drawn = seen.get("renderer") or {"name": NATIVE, "samples": None}
        size = _own_value(policy, "picture_size", size, 64) if pixels else 64
        repeat = seen.get("action_repeat", ACTION_REPEAT)
        shown = dict(renderer=drawn["name"], samples=drawn["samples"], action_repeat=repeat)
        scene = EvaluationScene.parse(where, backgrounds=backgrounds or BUILTIN, size=size, **shown)
    if scene.setting == FIXED:
        raise DmcvbError(f"{scene.task} has fixed goals here; score policies on them by `validate --benchmark b3`")
    if backgrounds is not None and not parse_setting(scene.task, scene.setting)[0].shows_videos:
        raise DmcvbError(f"{scene.task}/{scene.setting} shows no videos, so backgrounds have no effect: leave them out")
    if renderer not in (None, scene.renderer):
        scene = replace(scene, renderer=renderer, samples=None)
    given = dict(size=size, samples=samples, action_repeat=action_repeat, split=split)
    scene = replace(scene, **{name: value for name, value in given.items() if value is not None})
    limits = dict(episodes=episodes, seed=seed, max_steps=max_steps, threads=threads)
    with contextlib.closing(Evaluator(scene, pixels=pixels, stack=stack, **limits)) as evaluator:
        if isinstance(policy, TrainedAgent):
            _check_sizes(evaluator, policy)
        _tell_differences(scene, evaluator, seen)
        score = evaluator.score(policy)
    if isinstance(where, Subset):
        record = where.record
        if (score.limit, scene.action_repeat) == (record.max_steps, record.action_repeat):
            return replace(score, normalized=normalized(score.mean, reference_returns(where.release, record)))
    return score


def _own_value(policy: Act, name: str, given: Any, usual: Any) -> Any:
    """A property of the observations: the policy's own, else the given one, else the usual one.

    Raises:
      DmcvbError: another one is given than the policy's own.
    """
    own = getattr(policy, name, None)
    if own is not None and given not in (None, own):
        name = name.removeprefix("picture_")
        raise DmcvbError(f"{name} is {given}, and the policy learned with {own}; leave {name} out")
    return next(value for value in (own, given, usual) if value is not None)


def _check_sizes(evaluator: Evaluator, policy: TrainedAgent) -> None:
    """Raise DmcvbError if a trained policy's networks are made for other observations or actions."""
    task, scene, shown = evaluator.task, evaluator.scene, {}
    if policy.pixels:
        shown = {"channels": 3 * len(scene.pictures.views) * policy.stack}
    for name, size in {"state": task.state_size, "action": task.action_size, **shown}.items():
        own = getattr(policy.sizes, name)
        if own != size:
            told = f"{name} has size {size} in {task_folder(scene.task)}, and the policy learned with {own}"
            raise DmcvbError(f"{told}; evaluate it on the task that it learned")


def _tell_differences(scene: EvaluationScene, evaluator: Evaluator, seen: Mapping[str, Any]) -> None:
    """Log what an evaluation has otherwise than the data that a trained policy learned from."""
    here: dict[str, Any] = {"task": scene.task, "action_repeat": scene.action_repeat}
    if evaluator.renderer is not None:
        here["renderer"] = {"name": scene.renderer, "samples": scene.samples}
    if scene.split == SPLIT and seen.get("backgrounds") and evaluator.videos is not None:
        here["backgrounds"] = evaluator.videos.digest
    seen = {"action_repeat": ACTION_REPEAT, **seen} if seen else seen
    for name, value in here.items():
        if value != seen.get(name, value):
            _log.warning("the policy's own evaluation has %s %s, this one %s", name, seen[name], value)


# -- trained policies -------------------------------------------------------------------------------


@dataclass(frozen=True)
class TrainedAgent:
    """A trained policy, to call with a batch of observations as `evaluate` gives them.

    Attributes:
      agent: what it is, e.g. "id+bc" by its name. sizes: sizes of its observations and actions.
      policy, normalization: its networks, and the normalization of the states that it learned from.
      evaluation: what decides the evaluation that belongs to its data (`cell.evaluation_of`); {} if it is not known.
    """

    agent: Agent
    sizes: Sizes
    policy: Policy
    normalization: Normalization
    evaluation: Mapping[str, Any] = field(default_factory=dict)

    @property
    def pixels(self) -> bool:
        """True if it sees pictures."""
        return not self.agent.sees_state

    @property
    def stack(self) -> int:
        """Frames an observation."""
        return self.agent.stack

    @property
    def picture_size(self) -> int | None:
        """Pixels a side of its pictures; None if it sees states."""
        return self.sizes.picture or None

    def __call__(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """Return (episode, action) float32 in [-1, 1] for the observations of all episodes."""
        import torch

        from dmcvb_gen.agents.data import normalize_pixels

        device = next(self.policy.parameters()).device
        if self.pixels:
            seen = normalize_pixels(torch.from_numpy(observation["pixels"]).to(device))
        else:
            seen = self.normalization(torch.from_numpy(observation["state"])).to(device)
        with torch.no_grad(), self.policy.precision():
            return self.policy.act(seen).float().clamp(-1, 1).cpu().numpy()

    def save(self, path: Path, network: Architecture) -> None:
        """Write the weights that act, the normalization, and a header with all that the networks are made from."""
        from safetensors.torch import save_file

        facts = {
            "format": FORMAT,
            "agent": self.agent.name,
            "sizes": asdict(self.sizes),
            "network": asdict(network),
            "half": self.policy.half,
            "evaluation": dict(self.evaluation),
        }
        tensors = {name: value for name, value in self.policy.state_dict().items() if self.policy.acts_by(name)}
        tensors |= {"normalization.mean": self.normalization.mean, "normalization.std": self.normalization.std}
        with replacing(path) as temporary:
            whole = {name: value.detach().cpu().clone().contiguous() for name, value in tensors.items()}
            save_file(whole, str(temporary), metadata={"facts": json.dumps(facts)})


FORMAT = "dmcvb-gen trained agent"


def load_agent(path: str | Path) -> TrainedAgent:
    """The trained policy of a file that `validate` wrote beside a cell's result. Nothing in it can run code.

    Raises:
      DmcvbError: there is no such file, or it holds something else.
    """
    import torch
    from safetensors import SafetensorError, safe_open

    from dmcvb_gen.agents.catalog import make_encoder, make_policy, parse_agent
    from dmcvb_gen.agents.data import Normalization, Sizes
    from dmcvb_gen.agents.networks import Architecture

    try:
        with safe_open(str(path), "pt") as file:
            facts = json.loads((file.metadata() or {}).get("facts", "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
        if facts.get("format") != FORMAT:
            raise ValueError("another format")
        normalization = Normalization(tensors.pop("normalization.mean"), tensors.pop("normalization.std"))
        agent, sizes, network = parse_agent(facts["agent"]), Sizes(**facts["sizes"]), Architecture(**facts["network"])
        if normalization.mean.shape != (sizes.state,) or normalization.std.shape != (sizes.state,):
            raise ValueError("the normalization does not fit")
        for device in ("meta", "cpu"):  # without memory first: a file may name any size
            with torch.device(device):
                encoder = make_encoder(agent, sizes, architecture=network)
                policy = make_policy(agent, encoder, sizes, network)
            missing, unexpected = policy.load_state_dict(tensors, strict=False, assign=device == "meta")
            if unexpected or any(map(policy.acts_by, missing)):
                raise ValueError("its weights do not fit")
        policy.half = bool(facts["half"])
        return TrainedAgent(agent, sizes, policy.eval(), normalization, dict(facts.get("evaluation", {})))
    except (OSError, SafetensorError, RuntimeError, LookupError, ValueError, TypeError, AttributeError) as error:
        raise DmcvbError(f"{path} is no agent that validate trained ({first_line(error)})") from None
