"""Make the figures of these pages, from rollouts and trainings of their own.

    python docs/concepts/figures.py
    python docs/concepts/figures.py delayed-messages local-policies
    python docs/concepts/figures.py compounding-errors --cloned runs/<date>-<name> --dagger runs/<date>-<name>

All of them take half an hour on one core; the two trainings of compounding-errors take most of it, unless the run
folders of finished ones are given. Needs matplotlib (``pip install -e '.[plots]'``).
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.modules import set_recurrent_mode

from modgnn_rl import ModGNN, load_policy, make_model
from modgnn_rl.configs.schema import BCConfig, DAggerConfig, EvaluationConfig, FlockingConfig, ModelConfig, TrainConfig
from modgnn_rl.envs.flocking.expert import LocalReynolds, Reynolds
from modgnn_rl.envs.flocking.metrics import leader_lost
from modgnn_rl.envs.flocking.task import FlockingTask
from modgnn_rl.evaluation.metrics import action_error
from modgnn_rl.evaluation.rollout import make_eval_env
from modgnn_rl.experiment.training import train
from modgnn_rl.reporting.figure import GRID, INK, PAPER, draw, styles_of
from modgnn_rl.reporting.plots import Curve, draw_curves, draw_panels
from modgnn_rl.utils.seeds import seeded

HERE = Path(__file__).parent
BIN = 20  # steps of a rollout that make one point of a curve
ACTION, EXPERT_ACTION = ("agents", "action"), ("agents", "expert_action")


def cone(policy: ModGNN, agents: int, steps: int) -> Tensor:
    """What the last action of the first of several agents on a line depends on.

    Each agent hears the ones beside it.

    Returns:
        the sum of the absolute derivatives by each agent's observation at each of the steps before it, [T, N].
    """
    numbers = torch.arange(agents)
    adjacency = (numbers.unsqueeze(-1) - numbers).abs() == 1
    generator = torch.Generator().manual_seed(0)
    observation = torch.randn(1, steps, agents, 6, dtype=torch.float64, generator=generator).requires_grad_()
    window = TensorDict(
        {"agents": {"observation": observation}, "adjacency": adjacency.expand(1, steps, -1, -1)}, [1, steps]
    )
    with set_recurrent_mode(True):
        action = policy.double()(window)["agents", "action"][0, -1, 0]
    slopes = [torch.autograd.grad(part, observation, retain_graph=True)[0].abs().sum(-1)[0] for part in action]
    return torch.stack(slopes).sum(0)


def delayed_messages(figure: Figure) -> None:
    """Space-time cones of four models."""
    agents, steps = 5, 5
    with seeded(0):
        cones = {
            "modgnn_mlp, K = 1": cone(make_model("modgnn_mlp"), agents, steps),
            "modgnn_mlp, K = 3": cone(make_model("modgnn_mlp", hops=3), agents, steps),
            "modgnn_adjacency, K = 3": cone(make_model("modgnn_adjacency", hops=3), agents, steps),
            "moment_force: 2 layers, K = 1": cone(make_model("moment_force"), agents, steps),
        }
    colour = styles_of(["modgnn_mlp"])["modgnn_mlp"].colour
    for number, (title, slopes) in enumerate(cones.items()):
        axes = figure.add_subplot(2, 2, number + 1, title=title)
        axes.grid(visible=False)
        reached = slopes > 0
        for step in range(1, steps):
            for agent in range(agents):
                for before in (agent - 1, agent, agent + 1):
                    if 0 <= before < agents and reached[step, agent] and reached[step - 1, before]:
                        line = "-" if before != agent else ":"
                        axes.plot([step - 1, step], [before, agent], line, color=colour, linewidth=1.1, alpha=0.6)
        for is_reached, look in ((True, {"color": colour}), (False, {"facecolor": PAPER, "edgecolor": GRID})):
            step, agent = (reached == is_reached).nonzero(as_tuple=True)
            axes.scatter(step, agent, s=46, zorder=3, linewidths=1.2, **look)
        axes.scatter([steps - 1], [0], s=130, facecolor="none", edgecolor=INK, linewidths=1.3, zorder=4)
        axes.set_xticks(range(steps), ["t" if back == 0 else f"t - {back}" for back in range(steps - 1, -1, -1)])
        axes.set_yticks(range(agents), ["itself", *(f"{hops} links" if hops > 1 else "1 link" for hops in range(1, 5))])
        axes.set(xlim=(-0.4, steps - 0.55), ylim=(-0.6, agents - 0.6))
        axes.tick_params(length=0)
        axes.spines[["left", "bottom"]].set_visible(False)


def errors(
    policy: TensorDictModuleBase, env_config: FlockingConfig, *, flocks: int, steps: int, expert_acts: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """The error of a policy's actions over time, on rollouts of its own or of the expert, from the same fresh starts.

    Returns:
        errors, m^2/s^2, and shares of the time at which nobody heard the leader, in bins of `BIN` steps
        [flocks, bins].
    """
    task, expert, size = FlockingTask(env_config), Reynolds.for_env(env_config), env_config.sizes[0]
    env = make_eval_env(policy, task, flocks, size, steps=steps, seed=1_000_000)
    found, lost = [], []
    state = env.reset()
    with torch.no_grad(), set_recurrent_mode(False):
        for _ in range(steps):
            state = expert(policy(state))
            agents = state["agents"]
            difference = task.actions.difference(agents["action"], agents["expert_action"])
            found.append(action_error(difference, agents["controlled"]))
            lost.append(leader_lost(agents["observation"][..., :3], env_config.comm_range).double())
            if expert_acts:
                state[ACTION] = state[EXPERT_ACTION]
            state = env.step_mdp(env.step(state))
    env.close()
    binned = [torch.stack(values, 1).unflatten(1, (-1, BIN)).mean(-1).numpy() for values in (found, lost)]
    return binned[0], binned[1]


def curves(values: Mapping[str, np.ndarray], env_config: FlockingConfig) -> dict[str, Curve]:
    """Means over flocks [flocks, bins] with their 95 % intervals, over seconds."""
    rng = np.random.default_rng(0)
    length = BIN / env_config.control_frequency
    return {
        name: Curve.over_seeds((np.arange(measured.shape[1]) + 0.5) * length, measured, rng=rng)
        for name, measured in values.items()
    }


def trained(env_config: FlockingConfig, trainer: Any, finished: Path | None) -> ModGNN:
    """A policy whose robots hear over one link, of a finished run or trained now."""
    if finished is not None:
        return load_policy(finished)
    with tempfile.TemporaryDirectory() as runs:
        config = TrainConfig(
            env=env_config,
            model=ModelConfig(name="modgnn_mlp"),
            trainer=trainer,
            evaluation=EvaluationConfig(num_flocks=2, steps=4),
            runs=runs,
        )
        return load_policy(train(config).path)


def compounding_errors(cloned: Path | None = None, dagger: Path | None = None) -> Callable[[Figure], None]:
    """Two policies of the paper's model, cloned and trained by DAgger, on the expert's rollouts and on their own."""
    env_config = FlockingConfig()
    policies: dict[str, TensorDictModuleBase] = {
        "cloned": trained(env_config, BCConfig(), cloned),
        "DAgger": trained(env_config, DAggerConfig(rounds=60), dagger),
        "expert, 1 hop": LocalReynolds.for_env(env_config, action=ACTION),
    }
    titles = {"on the expert's rollouts": True, "on rollouts of its own": False}
    panels = {}
    for title, expert_acts in titles.items():
        found = {
            name: errors(policy, env_config, flocks=40, steps=1000, expert_acts=expert_acts)[0]
            for name, policy in policies.items()
        }
        for name, values in found.items():
            print(f"{title}: {name} {values.mean():.3f} m²/s²")
        panels[title] = curves(found, env_config)

    def onto(figure: Figure) -> None:
        for panel, drawn in zip(draw_panels(figure, list(titles)), panels.values(), strict=True):
            draw_curves(
                panel,
                drawn,
                x_label="time, s",
                y_label="error, m²/s²",
                references={"zero action": env_config.max_speed**2 / 3},
            )

    return onto


def local_policies() -> Callable[[Figure], None]:
    """The expert's own rule with the eyes of a local policy."""
    env_config = FlockingConfig()
    experts = {
        "expert, 1 hop": LocalReynolds.for_env(env_config, hops=1, action=ACTION),
        "expert, 2 hops": LocalReynolds.for_env(env_config, hops=2, action=ACTION),
        "expert, sees all": Reynolds.for_env(env_config, action=ACTION),
    }
    measured = {name: errors(expert, env_config, flocks=100, steps=1000) for name, expert in experts.items()}
    for name, (error, lost) in measured.items():
        print(f"{name}: {error.mean():.3f} m²/s², at the end {error[:, -1].mean():.3f}, lost {lost[:, -1].mean():.0%}")
    errors_of = curves({name: error for name, (error, _) in measured.items()}, env_config)
    lost_of = curves({name: 100 * lost for name, (_, lost) in measured.items()}, env_config)

    def onto(figure: Figure) -> None:
        left, right = draw_panels(
            figure, ["error against the expert that sees all", "flocks whose leader nobody hears"]
        )
        draw_curves(left, errors_of, x_label="time, s", y_label="error, m²/s²")
        draw_curves(right, lost_of, x_label="time, s", y_label="share, %")

    return onto


NAMES = ("delayed-messages", "compounding-errors", "local-policies")


def main(names: list[str], cloned: Path | None = None, dagger: Path | None = None) -> None:
    """Make some figures, or all."""
    torch.set_num_threads(1)
    made: dict[str, Callable[[], Callable[[Figure], None]]] = {
        "delayed-messages": lambda: delayed_messages,
        "compounding-errors": lambda: compounding_errors(cloned, dagger),
        "local-policies": local_policies,
    }
    for name in names or NAMES:
        picture = draw(name, made[name]()).png
        (HERE / f"{name}.png").write_bytes(picture)
        print(f"{name}.png, {len(picture) / 1000:.0f} kB")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", choices=[*NAMES, []], help="which; default: all")
    parser.add_argument("--cloned", type=Path, help="run folder of trainer=bc")
    parser.add_argument("--dagger", type=Path, help="run folder of trainer=dagger, of the same model")
    main(**vars(parser.parse_args()))
