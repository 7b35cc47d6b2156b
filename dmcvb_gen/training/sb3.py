"""Train with an algorithm of Stable-Baselines3 or sb3-contrib, "sb3:NAME", into a run's folder of policy files.

Settings are the arguments of the algorithm's class. Policies are exported as everybody's zips are, by
`policies.convert`. A run goes on from SB3's own parameters and its replay buffer, with new episodes; nothing is
unpickled. Steps of an on-policy algorithm since its last update are not kept. Nothing is normalized. To use
VecNormalize, train with SB3 on an environment of this package, and convert the zip.
"""

from __future__ import annotations

import copy
import dataclasses
import inspect
import re
import tempfile
from pathlib import Path
from typing import Any, Literal

import numpy as np
import sb3_contrib
import stable_baselines3
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.noise import NormalActionNoise

from dmcvb_gen.errors import DmcvbError, PolicyFileError, UnknownNameError, first_line
from dmcvb_gen.policies.convert import UNCLIPPED, convert
from dmcvb_gen.training.networks import as_tensors
from dmcvb_gen.training.run import Run
from dmcvb_gen.training.settings import SB3, Count, Natural, NonNegative
from dmcvb_gen.training.vec_env import TaskVecEnv

ALGORITHMS = ("A2C", "CrossQ", "DDPG", "PPO", "SAC", "TD3", "TQC", "TRPO")
"""Those whose actors for continuous actions are plain MLPs, which policy files hold."""
NOT_SET = ("self", "policy", "env", "device", "verbose", "seed", "tensorboard_log", "_init_setup_model")
NOT_SET += ("optimize_memory_usage",)
"""Arguments of an algorithm that the run gives, or that its saved buffer does not know."""
OURS = {"simulations": 8}
KINDS: dict[Any, Any] = {bool: bool, int: Count, float: NonNegative, str: float | str}
KINDS |= {"gradient_steps": Literal[-1] | Count, "learning_starts": Natural, "top_quantiles_to_drop_per_net": Natural}
KINDS |= dict.fromkeys(("action_noise", "clip_range_vf", "target_kl"), NonNegative | None)
"""Argument, or the type of its default -> what it may be."""
MEANINGS = """Settings of an algorithm of SB3.

Attributes:
  simulations: episodes stepped side by side.
"""
BUFFER = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def algorithm_class(algorithm: str) -> type[BaseAlgorithm]:
    """The class that "sb3:NAME" names.

    Raises:
      UnknownNameError: neither package has it, or its actors cannot be exported.
    """
    name = algorithm.removeprefix(SB3)
    if name not in ALGORITHMS:
        raise UnknownNameError("algorithm of Stable-Baselines3 with plain MLP actors", name, ALGORITHMS)
    return getattr(sb3_contrib, name, None) or getattr(stable_baselines3, name)


def settings_class(algorithm: str) -> type:
    """A data class of the arguments of an algorithm, with their defaults, documented as SB3 documents them."""
    kind = algorithm_class(algorithm)
    given = inspect.signature(kind).parameters
    defaults = {name: value.default for name, value in given.items() if name not in NOT_SET}
    values = OURS | defaults
    fields = [(n, KINDS.get(n) or KINDS.get(type(v), Any), dataclasses.field(default=v)) for n, v in values.items()]
    lines = re.findall(r":param (\w+): (.+(?:\n(?!\s*:).+)*)", kind.__doc__ or "")
    documented = {name: " ".join(text.split()).rstrip(".") for name, text in lines}
    meanings = "".join(f"  {name}: {documented.get(name, 'see Stable-Baselines3')}.\n" for name in defaults)
    return dataclasses.make_dataclass("Settings", fields, frozen=True, namespace={"__doc__": MEANINGS + meanings})


def network(run: Run) -> dict[str, Any]:
    """The header's fields that say how the actor is built: known once a model is exported."""
    return {"hidden": ()}


def check(run: Run) -> None:
    """Refuse, before anything is written, what SB3 refuses, or a policy that cannot be exported.

    Raises:
      DmcvbError: what is wrong and the cure.
    """
    if run.config.init_from:
        raise DmcvbError(f"--init-from has no effect with --algo {run.config.algorithm}: remove it")
    export(run, make_model(run))


def make_model(run: Run) -> BaseAlgorithm:
    """A new model on the run's task.

    Raises:
      DmcvbError: SB3 does not accept the settings.
    """
    # A copy, as SB3 writes into dicts that it is given.
    given = copy.deepcopy({name: value for name, value in vars(run.settings).items() if name not in OURS})
    if isinstance(noise := given.get("action_noise"), int | float):
        given["action_noise"] = NormalActionNoise(np.zeros(run.task.action_size), np.full(run.task.action_size, noise))
    seed = run.config.seed
    if run.step:  # it goes on, with new episodes and new noise
        seed = int(np.random.default_rng([seed, run.step]).integers(2**31))
    env = TaskVecEnv(run.task, run.settings.simulations, seed)
    try:
        model = algorithm_class(run.config.algorithm)("MlpPolicy", env, seed=seed, device="cpu", **given)
    except Exception as error:  # SB3's, torch's and numpy's own kinds
        raise DmcvbError(f"{run.config.algorithm} does not accept this: {first_line(error)}; change --set") from None
    model.set_logger(Logger(None, []))  # its own makes a folder in the system's temporary folder each time
    return model


def export(run: Run, model: BaseAlgorithm) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Weights of the policy file, and the fields of its header that say how the actor is built."""
    with tempfile.TemporaryDirectory() as folder:
        model.save(Path(folder, "model.zip"))
        try:
            header, weights = convert(Path(folder, "model.zip"), run.task.id)
        except PolicyFileError as error:
            raise PolicyFileError(str(error).replace(f"{folder}/model.zip", run.config.algorithm)) from None
    built = {name: getattr(header, name) for name in ("hidden", "activation", "distribution")}
    return as_tensors(weights), built | {"clip_observation": UNCLIPPED}


def state_of(model: BaseAlgorithm) -> dict[str, Any]:
    """What a run goes on from."""
    variables = {name: getattr(model, name).detach() for name in model._get_torch_save_params()[1]}
    state: dict[str, Any] = {"parameters": model.get_parameters(), "variables": variables, "updates": model._n_updates}
    if buffer := getattr(model, "replay_buffer", None):
        state["buffer"] = {name: torch.from_numpy(getattr(buffer, name)[: buffer.size()]) for name in BUFFER}
        state |= {"position": buffer.pos, "full": buffer.full}
    return state


def restore(model: BaseAlgorithm, saved: dict[str, Any]) -> None:
    """Go on from `state_of`."""
    model.set_parameters(saved["parameters"], device="cpu")
    for name, value in saved["variables"].items():
        getattr(model, name).data.copy_(value)
    if "buffer" in saved:
        for name, value in saved["buffer"].items():
            getattr(model.replay_buffer, name)[: len(value)] = value.numpy()
        model.replay_buffer.pos, model.replay_buffer.full = saved["position"], saved["full"]
        model.replay_buffer.timeouts[saved["position"] - 1] = True  # episodes begin anew
    model.num_timesteps, model._n_updates = saved["step"], saved["updates"]


def train(run: Run) -> None:
    """Train until the run's last step, or until it is stopped."""
    model = make_model(run)
    run.header = run.header.model_copy(update=export(run, model)[1])
    if saved := run.saved():
        restore(model, saved)
    else:
        run.save(state_of(model))

    def after_step(*_: Any) -> bool:
        run.advance(run.settings.simulations)
        if run.evaluation_is_due():
            logged = {name.removeprefix("train/"): value for name, value in model.logger.name_to_value.items()}
            metrics = {name: float(value) for name, value in logged.items() if np.isscalar(value)}
            run.record(export(run, model)[0], model._n_updates, metrics)
        run.checkpoint_if_due(lambda: state_of(model), lambda: export(run, model)[0])
        return run.step < run.config.steps

    if run.step < run.config.steps:
        model.learn(run.config.steps - run.step, after_step, log_interval=None, reset_num_timesteps=False)
    run.save(state_of(model))
    if not model._n_updates:
        raise DmcvbError(
            f"{run.config.algorithm} learned nothing in {run.step:,} steps; give more --steps, or less n_steps, "
            "train_freq or learning_starts with --set"
        )
