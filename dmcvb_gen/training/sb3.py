"""Runs of Stable-Baselines3's algorithms: the same folders, policy files and resuming as the package's own SAC.

SB3's own save files are pickles inside a zip, so they are neither written nor read: parameters, replay buffer,
normalization, simulations and random states are saved as tensors, numbers and rows of float32.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from sb3_contrib import TQC
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.policies.header import LOG_STD_RANGE
from dmcvb_gen.state_file import STATE
from dmcvb_gen.training.networks import Actor, as_tensors
from dmcvb_gen.training.row_files import check_rows, map_rows, rows_in
from dmcvb_gen.training.runs import ProgressCallback, Report, Run, policy_to_start_from, read_config
from dmcvb_gen.training.settings import OffPolicySettings
from dmcvb_gen.training.vec_env import TaskVecEnv

CLIP_OBSERVATION = 10.0
UNCLIPPED = 1e30
"""Stands for "not clipped" in a policy file's header."""
ROUND_STEPS = 500
"""Agent steps between two moments at which a run may be saved or stopped."""
BUFFER_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
_CLASSES = {"sb3-sac": SAC, "tqc": TQC, "td3": TD3, "ppo": PPO}
_SAC_SETTINGS = ("ent_coef", "target_entropy")
_OFF_POLICY = ("buffer_size", "learning_starts", "tau", "train_freq", "gradient_steps")
_ARGUMENTS = {
    "sb3-sac": (*_OFF_POLICY, *_SAC_SETTINGS),
    "tqc": (*_OFF_POLICY, *_SAC_SETTINGS, "top_quantiles_to_drop_per_net"),
    "td3": (*_OFF_POLICY, "policy_delay", "target_policy_noise", "target_noise_clip"),
    "ppo": ("n_steps", "n_epochs", "gae_lambda", "clip_range", "ent_coef", "vf_coef", "max_grad_norm"),
}
"""Settings that are arguments of the SB3 class, beside those that all have."""


class _Ticker(BaseCallback):
    """Tells of every step of all simulations."""

    def __init__(self, tick: ProgressCallback):
        super().__init__()
        self._tick = tick

    def _on_step(self) -> bool:
        self._tick(self.training_env.num_envs)
        return True


class Sb3Run(Run):
    """A run of `sb3-sac`, `tqc`, `td3` or `ppo`."""

    warmup_setting = "learning_starts"

    def network(self) -> dict[str, Any]:
        settings, name = self.settings, self.config.algorithm
        fields: dict[str, Any] = {"hidden": tuple(settings.hidden)}
        fields["clip_observation"] = CLIP_OBSERVATION if settings.normalize_observation else UNCLIPPED
        if name == "ppo":
            fields |= {"distribution": "gaussian", "activation": "tanh"}
        elif name == "td3":
            fields |= {"distribution": "deterministic", "noise": settings.action_noise}
        return fields

    def warmup(self) -> int:
        return self.settings.learning_starts if isinstance(self.settings, OffPolicySettings) else 0

    def problem(self) -> str | None:
        """Say what SB3, or what the run starts from, refuses; before anything is written."""
        if (self.folder / "resume" / STATE).exists():
            return None
        try:
            self._begin()
        except DmcvbError as error:
            return str(error)
        return None

    def _begin(self, saved: bool = False) -> tuple[TaskVecEnv, VecNormalize | None, BaseAlgorithm]:
        """Simulations, what normalizes them if anything does, and a model; unless saved, of what it starts from."""
        settings, source = self.settings, self.config.init_from
        env = TaskVecEnv(self.task, settings.simulations, self.config.seed)
        normalize = None
        if settings.normalize_observation or settings.normalize_reward:
            normalize = VecNormalize(
                env,
                norm_obs=settings.normalize_observation,
                norm_reward=settings.normalize_reward,
                clip_obs=CLIP_OBSERVATION,
                gamma=settings.gamma,
            )
        model = self._model(normalize or env)
        if source and not saved:
            self._start_from(source, model, normalize)
        return env, normalize, model

    def _train(self, saved: dict[str, Any] | None, report: Report, tick: ProgressCallback) -> None:
        config, settings = self.config, self.settings
        env, normalize, model = self._begin(saved is not None)
        buffer = self._map_buffer(model, saved) if isinstance(settings, OffPolicySettings) else None
        next_evaluation = config.evaluate_every
        if saved:
            self._restore(saved, model, env, normalize, buffer)
            next_evaluation = saved["next_evaluation"]

        def state() -> dict[str, Any]:
            return self._state(model, env, normalize, buffer) | {"next_evaluation": next_evaluation}

        while self.step < config.steps:
            steps = min(next_evaluation, config.steps, self.step + ROUND_STEPS) - self.step
            model.set_logger(Logger(None, []))  # its own makes a folder in the system's temporary folder each time
            model.learn(steps, callback=_Ticker(tick), log_interval=None, reset_num_timesteps=False)
            self.step = model.num_timesteps
            if self.step >= min(next_evaluation, self.config.steps):
                progress = self.record(
                    self._actor_weights(model, normalize), model._n_updates, self._metrics(model), report
                )
                next_evaluation = self.next_evaluation(progress.evaluation, next_evaluation)
            self.between_rounds(state)
        self.save(state())

    def _model(self, env: VecEnv) -> BaseAlgorithm:
        settings, name = self.settings, self.config.algorithm
        policy = {"net_arch": list(settings.hidden)}
        arguments = {key: getattr(settings, key) for key in _ARGUMENTS[name]}
        if "buffer_size" in arguments:
            arguments["buffer_size"] = max(min(settings.buffer_size, self.config.steps), settings.simulations)
        if name == "tqc":
            policy |= {"n_critics": settings.n_critics, "n_quantiles": settings.n_quantiles}
        if name == "td3" and settings.action_noise:
            size = self.task.action_size
            arguments["action_noise"] = NormalActionNoise(np.zeros(size), np.full(size, settings.action_noise))
        try:
            return _CLASSES[name](
                "MlpPolicy",
                env,
                learning_rate=settings.learning_rate,
                gamma=settings.gamma,
                batch_size=settings.batch_size,
                policy_kwargs=policy,
                seed=self.config.seed,
                device="cpu",
                **arguments,
            )
        except (ValueError, AssertionError) as error:
            reason = " ".join(str(error).split())
            raise DmcvbError(f"{name} does not accept these settings: {reason}; change them with --set") from None

    # -- policy files -----------------------------------------------------------------------

    def _names(self) -> dict[str, str]:
        """Weights of our actor -> parameters of SB3's policy."""
        last = 2 * len(self.settings.hidden)  # linear layers and activations alternate
        prefixes = {
            "ppo": {"body.": "mlp_extractor.policy_net.", "mean.": "action_net.", "log_std_vector": "log_std"},
            "td3": {"body.": "actor.mu.", "mean.": f"actor.mu.{last}."},
        }.get(self.config.algorithm, {"body.": "actor.latent_pi.", "mean.": "actor.mu.", "log_std.": "actor.log_std."})
        names = {}
        for ours in Actor(self.header).state_dict():
            for prefix, theirs in prefixes.items():
                if ours.startswith(prefix):
                    names[ours] = theirs + ours.removeprefix(prefix)
        return names

    def _actor_weights(self, model: BaseAlgorithm, normalize: VecNormalize | None) -> dict[str, torch.Tensor]:
        theirs, weights = model.policy.state_dict(), Actor(self.header).state_dict()
        weights |= {ours: theirs[name].detach() for ours, name in self._names().items()}
        if normalize and normalize.norm_obs:
            weights["observation_mean"] = torch.from_numpy(normalize.obs_rms.mean).float()
            std = np.sqrt(normalize.obs_rms.var + normalize.epsilon)
            weights["observation_std"] = torch.from_numpy(std).float()
        return weights

    def _metrics(self, model: BaseAlgorithm) -> dict[str, float]:
        values = {}
        for name, value in model.logger.name_to_value.items():
            if name.startswith("train/") and np.isscalar(value):
                values[name.removeprefix("train/")] = float(value)
        if "ent_coef" in values:
            values["temperature"] = values.pop("ent_coef")
        return values

    # -- resuming ---------------------------------------------------------------------------

    def _map_buffer(self, model: BaseAlgorithm, saved: dict[str, Any] | None) -> ReplayBuffer:
        """Put SB3's replay buffer into files, (rows, simulations, ...) float32 each."""
        buffer, folder = model.replay_buffer, self.folder / "resume"
        paths = {name: folder / f"{name}.f32" for name in BUFFER_ARRAYS}
        shapes = {name: getattr(buffer, name).shape[1:] for name in BUFFER_ARRAYS}
        found = min(rows_in(paths[name], shapes[name]) for name in BUFFER_ARRAYS)
        if saved:
            check_rows(self.folder, found, **saved["buffer"])
        rows = max(buffer.buffer_size, found)
        for name in BUFFER_ARRAYS:
            setattr(buffer, name, map_rows(paths[name], rows, shapes[name])[:rows])
        buffer.buffer_size = rows
        return buffer

    def _state(
        self, model: BaseAlgorithm, env: TaskVecEnv, normalize: VecNormalize | None, buffer: ReplayBuffer | None
    ) -> dict[str, Any]:
        _, key, position, has_gauss, cached = np.random.get_state()
        state: dict[str, Any] = {
            "parameters": model.get_parameters(),
            "variables": {name: getattr(model, name).detach() for name in model._get_torch_save_params()[1]},
            "counters": {"num_timesteps": model.num_timesteps, "updates": model._n_updates},
            "last": {name: torch.from_numpy(np.array(getattr(model, name))) for name in self._last(normalize)},
            "env": env.saved(),
            "torch_rng": torch.get_rng_state(),
            "numpy_rng": {"key": torch.from_numpy(key.astype(np.int64)), "position": position},
            "gauss": {"has": has_gauss, "cached": cached},
            "space_rng": json.dumps(model.action_space.np_random.bit_generator.state),
        }
        if normalize:
            state["normalize"] = {"returns": torch.from_numpy(normalize.returns.copy())}
            for name in ("obs_rms", "ret_rms"):
                if hasattr(normalize, name):
                    state["normalize"][name] = _statistics(getattr(normalize, name))
        if buffer:
            for name in BUFFER_ARRAYS:
                getattr(buffer, name).flush()
            state["buffer"] = {"position": buffer.pos, "full": buffer.full, "rows": buffer.buffer_size}
        return state

    def _last(self, normalize: VecNormalize | None) -> tuple[str, ...]:
        """Return what the model remembers of the step before."""
        return ("_last_obs", "_last_episode_starts", *(("_last_original_obs",) if normalize else ()))

    def _restore(
        self,
        saved: dict[str, Any],
        model: BaseAlgorithm,
        env: TaskVecEnv,
        normalize: VecNormalize | None,
        buffer: ReplayBuffer | None,
    ) -> None:
        try:
            model.set_parameters(saved["parameters"], device="cpu")
            with torch.no_grad():
                for name, value in saved["variables"].items():
                    getattr(model, name).copy_(value)
            model.num_timesteps, model._n_updates = saved["counters"]["num_timesteps"], saved["counters"]["updates"]
            for name, value in saved["last"].items():
                setattr(model, name, value.numpy().copy())
            env.restore(saved["env"])
            if normalize:
                normalize.returns = saved["normalize"]["returns"].numpy().copy()
                for name in ("obs_rms", "ret_rms"):
                    if name in saved["normalize"]:
                        _set_statistics(getattr(normalize, name), saved["normalize"][name])
            if buffer:
                place = saved["buffer"]
                grown = place["full"] and buffer.buffer_size > place["rows"]
                buffer.pos, buffer.full = (place["rows"], False) if grown else (place["position"], place["full"])
            torch.set_rng_state(saved["torch_rng"])
            numpy_rng, gauss = saved["numpy_rng"], saved["gauss"]
            key = numpy_rng["key"].numpy().astype(np.uint32)
            np.random.set_state(("MT19937", key, numpy_rng["position"], gauss["has"], gauss["cached"]))
            model.action_space.np_random.bit_generator.state = json.loads(saved["space_rng"])
        except (KeyError, RuntimeError, ValueError) as error:
            reason = " ".join(str(error).split())[:200]
            raise DmcvbError(f"{self.folder} cannot be resumed ({reason}); start again with another --out") from None

    def _start_from(self, source: str, model: BaseAlgorithm, normalize: VecNormalize | None) -> None:
        """Take networks and normalization from a run of the same algorithm, or the actor alone from a policy file."""

        def fit(load: Callable[[], Any]) -> None:
            try:
                load()
            except (KeyError, RuntimeError, ValueError) as error:
                reason = " ".join(str(error).split())[:200]
                raise DmcvbError(f"--init-from {source} does not fit these settings and task ({reason})") from None

        unnormalized = f"--init-from {source} normalizes observations; give --set normalize_observation=true"
        config, name = read_config(source), self.config.algorithm
        if config:
            saved = type(self)(source, config).saved() if config.algorithm == name else None
            if not saved:
                raise DmcvbError(f"--init-from {source}: no run of {name} is saved there; give its folder or a policy")
            fit(lambda: model.policy.load_state_dict(saved["parameters"]["policy"]))
            statistics = saved.get("normalize", {}).get("obs_rms")
            if normalize and normalize.norm_obs:
                if statistics:
                    _set_statistics(normalize.obs_rms, statistics)
                else:  # its networks saw observations as they are
                    normalize.obs_rms.count = 1e5
            elif statistics:
                raise DmcvbError(unnormalized)
            return
        weights = as_tensors(policy_to_start_from(source, self.header).weights)
        names = self._names()
        if "log_std_vector" in weights and weights["log_std_vector"].min() < LOG_STD_RANGE[0]:
            names.pop("log_std_vector", None)  # it acts without noise, which PPO cannot learn from: SB3's own stays
        fit(lambda: model.policy.load_state_dict({name: weights[ours] for ours, name in names.items()}, False))
        if hasattr(model, "actor_target"):  # TD3's targets ask it for actions
            model.actor_target.load_state_dict(model.actor.state_dict())
        if normalize and normalize.norm_obs:
            std = weights["observation_std"].numpy().astype(float)
            normalize.obs_rms.mean = weights["observation_mean"].numpy().astype(float)
            normalize.obs_rms.var, normalize.obs_rms.count = std**2, 1e5
        elif weights["observation_mean"].any() or (weights["observation_std"] != 1).any():
            raise DmcvbError(unnormalized)


def _statistics(running: RunningMeanStd) -> dict[str, Any]:
    values = {name: torch.from_numpy(np.array(getattr(running, name))) for name in ("mean", "var")}
    return values | {"count": float(running.count)}


def _set_statistics(running: RunningMeanStd, saved: dict[str, Any]) -> None:
    running.mean, running.var = saved["mean"].numpy().copy(), saved["var"].numpy().copy()
    running.count = saved["count"]
