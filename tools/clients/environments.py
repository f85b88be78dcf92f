"""Integration tests of the environment with libraries of reinforcement learning, unpatched: two iterations, or their own checks.

Each client runs in a process of its own, in our interpreter or in the one that `--python NAME=PATH` names. Prints a table; a client that is
not installed is listed as such. Exits with 1 if a client fails. Nothing is fetched; an interpreter for all of them:
`pip install gymnasium torch skrl torchrl rsl-rl-lib stable-baselines3 tensorboard synpick-warp`.

    python -m tools.clients.environments --python all=VENV/bin/python
"""

# Runs where these libraries are, which the type checker may not see.
# pyright: reportMissingImports=false

import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from importlib.metadata import version
from typing import Any

import numpy as np

import synpick_warp
from tools.clients.base import finish, interpreters, run_module
from tools.options import fail, make_parser

SMALL: dict[str, Any] = {
    "config": "smoke",
    "num_envs": 2,
    "resolution": (64, 48),
    "seed": 3,
    "settings": {"arrangement.max_objects": 3, "pick.appear_height": 0.3, "pick.lift_height": 0.3, "pick.lift_speed": 1.0},
}
"""Small piles, whose attempts are short."""
STEPS, ITERATIONS = 4, 2
"""Steps of an iteration, and iterations."""


def make(device: str, **arguments: Any) -> Any:
    """A small environment."""
    return synpick_warp.make_env(**{**SMALL, "device": device, **arguments})


def check_gymnasium(device: str) -> str:
    """Check spaces, autoreset metadata and reproducibility by seed, as Gymnasium's tests of vector environments do; `make_vec` by id."""
    import gymnasium
    from gymnasium.utils.env_checker import data_equivalence

    name = "synpick_warp.environment.registration:SynPick/Pick-v0"
    env = gymnasium.make_vec(name, **SMALL, device=device, backend="numpy", obs=("depth", "state"), max_episode_steps=3)
    assert isinstance(env, gymnasium.vector.VectorEnv)
    assert isinstance(env.metadata["autoreset_mode"], gymnasium.vector.AutoresetMode)
    runs = []
    for _ in range(2):
        env.action_space.seed(3)
        results: list[Any] = [env.reset(seed=3)]
        for _ in range(2 * STEPS):
            actions = env.action_space.sample()
            assert actions in env.action_space
            results.append(env.step(actions))
            obs, reward, terminated, truncated, _ = results[-1]
            assert obs in env.observation_space
            assert reward.dtype == np.float32
            assert reward.shape == terminated.shape == truncated.shape == (env.num_envs,)
            assert terminated.dtype == truncated.dtype == bool
        runs.append(results)
    assert data_equivalence(*runs, exact=True)
    assert any(result[3].any() for result in runs[0][1:])
    return f"{2 * 2 * STEPS} steps, twice equal"


def record_statistics(device: str) -> str:
    """Record lengths of episodes by `RecordEpisodeStatistics`, in both modes of autoreset that it knows."""
    from gymnasium.wrappers.vector import RecordEpisodeStatistics

    lengths = []
    for mode in ("next_step", "same_step"):
        env = RecordEpisodeStatistics(make(device, backend="numpy", obs=("state",), autoreset=mode, max_steps=2))
        env.reset(seed=3)
        env.action_space.seed(3)
        for _ in range(STEPS * ITERATIONS):
            info = env.step(env.action_space.sample())[4]
            if "episode" in info:
                lengths += info["episode"]["l"][info["_episode"]].tolist()
    assert lengths
    assert set(lengths) <= {1, 2}
    return f"{len(lengths)} episodes"


def train_skrl(device: str) -> str:
    """Train by skrl's PPO with a categorical policy over columns and rows."""
    import torch
    from skrl.agents.torch.ppo import PPO, PPO_CFG
    from skrl.envs.wrappers.torch import wrap_env
    from skrl.memories.torch import RandomMemory
    from skrl.models.torch import DeterministicMixin, Model, MultiCategoricalMixin
    from skrl.trainers.torch import SequentialTrainer

    env = wrap_env(make(device, backend="torch", obs=("depth",)))

    class Policy(MultiCategoricalMixin, Model):
        def __init__(self) -> None:
            Model.__init__(self, observation_space=env.observation_space, action_space=env.action_space, device=env.device)
            MultiCategoricalMixin.__init__(self)
            self.net = torch.nn.LazyLinear(sum(SMALL["resolution"]))

        def compute(self, inputs: Mapping[str, Any], role: str) -> Any:
            return self.net(inputs["observations"]), {}

    class Value(DeterministicMixin, Model):
        def __init__(self) -> None:
            Model.__init__(self, observation_space=env.observation_space, action_space=env.action_space, device=env.device)
            DeterministicMixin.__init__(self)
            self.net = torch.nn.LazyLinear(1)

        def compute(self, inputs: Mapping[str, Any], role: str) -> Any:
            return self.net(inputs["observations"]), {}

    models = {"policy": Policy(), "value": Value()}
    for model in models.values():
        model.init_state_dict(role="policy")
    memory = RandomMemory(memory_size=STEPS, num_envs=env.num_envs, device=env.device)
    with tempfile.TemporaryDirectory() as folder:
        settings = {"rollouts": STEPS, "learning_epochs": 1, "mini_batches": 1, "experiment": {"directory": folder, "write_interval": 0}}
        agent = PPO(
            models=models,
            memory=memory,
            cfg=settings,
            observation_space=env.observation_space,
            state_space=None,
            action_space=env.action_space,
            device=env.device,
        )
        before = {name: values.clone() for name, values in models["policy"].state_dict().items()}
        trainer = SequentialTrainer(
            env=env, agents=agent, cfg={"timesteps": STEPS * ITERATIONS, "headless": True, "disable_progressbar": True}
        )
        trainer.train()
    assert any((values != before[name]).any() for name, values in models["policy"].state_dict().items())
    return f"{ITERATIONS} updates; {PPO_CFG.__name__}"


def check_torchrl(device: str) -> str:
    """Run `check_env_specs` on our adapter and on TorchRL's own wrapper, and a rollout with partial resets."""
    from torchrl.envs.libs.gym import GymWrapper
    from torchrl.envs.utils import check_env_specs

    from tools.examples.adapters.torchrl import TorchRlEnv

    env = TorchRlEnv(make(device, obs=("depth", "state"), autoreset="disabled", max_steps=2))
    check_env_specs(env)
    frames = env.rollout(STEPS * ITERATIONS, break_when_any_done=False)
    assert bool(frames["next", "done"].any())
    if device == "cpu":
        check_env_specs(GymWrapper(make(device, obs=("state",), action="twist", autoreset="disabled", max_steps=2)))
    return f"rollout {tuple(frames.shape)}"


def train_rsl_rl(device: str) -> str:
    """Train by rsl_rl's `OnPolicyRunner` (PPO) on state vectors, with actions as points."""
    from rsl_rl.runners import OnPolicyRunner

    from tools.examples.adapters.rsl_rl import RslRlEnv

    env = RslRlEnv(make(device, obs=("state",), action="point", autoreset="same_step", max_steps=2))
    model = {"class_name": "MLPModel", "hidden_dims": [32], "activation": "elu", "obs_normalization": True}
    gaussian = {"class_name": "GaussianDistribution", "init_std": 0.5, "std_type": "scalar"}
    ppo = {"class_name": "PPO", "num_learning_epochs": 1, "num_mini_batches": 1, "learning_rate": 1e-3, "gamma": 0.9, "lam": 0.9}
    settings = {
        "num_steps_per_env": STEPS,
        "save_interval": 100,
        "obs_groups": {"actor": ["state"], "critic": ["state"]},
        "actor": {**model, "distribution_cfg": gaussian},
        "critic": model,
        "algorithm": ppo,
    }
    OnPolicyRunner(env, settings, log_dir=None, device=device).learn(ITERATIONS, init_at_random_ep_len=True)
    return f"{ITERATIONS} iterations"


def train_stable_baselines3(device: str) -> str:
    """Train by stable-baselines3's PPO on state vectors, with actions as points; resets by seed are reproducible."""
    from stable_baselines3 import PPO

    from tools.examples.adapters.stable_baselines3 import Sb3Env

    env = Sb3Env(make(device, obs=("state",), action="point", autoreset="same_step", backend="numpy", max_steps=2))
    env.seed(7)
    first = env.reset()
    env.seed(7)
    assert np.array_equal(env.reset()["state"], first["state"])
    model = PPO("MultiInputPolicy", env, n_steps=STEPS, batch_size=STEPS, n_epochs=1, device=device)
    model.learn(STEPS * ITERATIONS * env.num_envs)
    return f"{model.num_timesteps} steps; PPO"


CLIENTS: Mapping[str, tuple[str, Callable[[str], str]]] = {
    "gymnasium": ("gymnasium", check_gymnasium),
    "statistics": ("gymnasium", record_statistics),
    "skrl": ("skrl", train_skrl),
    "torchrl": ("torchrl", check_torchrl),
    "rsl_rl": ("rsl-rl-lib", train_rsl_rl),
    "stable_baselines3": ("stable-baselines3", train_stable_baselines3),
}
"""Client -> its package, for the version, and its function, which returns a remark and raises on a failure. `--run` runs one here."""


def run_client(name: str, python: str, device: str) -> Any:
    """Run a client in a process of its interpreter; returns its row."""
    result, printed = run_module(name, python, "tools.clients.environments", "--run", device)
    if result.agreement:
        return result
    number, _, remark = next(line for line in reversed(printed.splitlines()) if "\t" in line).partition("\t")
    return replace(result, version=number, agreement="works", remarks=remark)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    given = sys.argv[1:] if arguments is None else arguments
    if "--run" in given:
        name, _, device = given
        package, run = CLIENTS[name]
        remark = run(device)
        print(f"\n{package} {version(package)}\t{remark}")
        return 0
    parser = make_parser(__doc__, "device", "json", device="cpu")
    parser.add_argument("--python", action="append", default=[], metavar="NAME=PATH", help="interpreter of a client, or of all")
    options = parser.parse_args(given)
    try:
        chosen = list(interpreters(CLIENTS, tuple(CLIENTS), options.python))
    except ValueError as error:
        return fail("environments", str(error))
    return finish("tools.clients.environments", options.json, [run_client(name, python, options.device) for name, python in chosen])


if __name__ == "__main__":
    sys.exit(main())
