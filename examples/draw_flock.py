"""Draw flocks that fly with a trained policy and with its expert from the same start, as a PNG.

    python examples/draw_flock.py 'runs/<date>-<name>' flock.png

Agents are dots, the leader is marked by a star, arrows are target velocities, thin lines are links of the
communication graph. Needs matplotlib.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import torch
from matplotlib import pyplot as plt
from mpl_toolkits.mplot3d.art3d import Line3DCollection
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import InitTracker, TransformedEnv

from modgnn_rl import load_policy
from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs import FlockingEnv
from modgnn_rl.experts import Reynolds
from modgnn_rl.loading import stored_world
from modgnn_rl.run_folder import RunFolder

STEPS = (72, 240, 960)  # 1.5 s, 5 s, 20 s
TRAIL = 96  # steps
ARROW = 0.9  # metres an arrow is long for 1 m/s
SEED = 12


def fly(policy: TensorDictModuleBase, world: FlockingConfig) -> dict[str, np.ndarray]:
    """Positions [T, N, 3], target velocities [T, N, 3] and graphs [T, N, N] of one flight of 32 agents."""
    env = TransformedEnv(FlockingEnv(1, 32, config=world, seed=SEED), InitTracker())
    if hasattr(policy, "make_tensordict_primer"):
        env.append_transform(policy.make_tensordict_primer())
    with torch.no_grad():
        flight = env.rollout(max(STEPS) + 1, policy, break_when_any_done=False)[0]
    return {
        "position": flight["agents", "observation"][..., :3].numpy(),
        "action": flight["agents", "action"].numpy(),
        "adjacency": flight["adjacency"].numpy(),
    }


def draw(axes: Any, flight: dict[str, np.ndarray], step: int) -> None:
    """Draw one moment of a flight, in a box of 6.6 m about the centre of the flock."""
    position, adjacency = flight["position"][step], flight["adjacency"][step]
    centre = position.mean(0)
    first = max(0, step - TRAIL)
    pairs = np.argwhere(np.triu(adjacency))
    axes.add_collection3d(Line3DCollection(position[pairs] - centre, colors="#e3b505", linewidths=0.5, alpha=0.3))
    if step:
        trails = flight["position"][first : step + 1].transpose(1, 0, 2) - centre
        axes.add_collection3d(Line3DCollection(trails[1:], colors="#5b6c8f", linewidths=0.8, alpha=0.5))
        axes.add_collection3d(Line3DCollection(trails[:1], colors="#c1292e", linewidths=1.4))
    followers = position[1:] - centre
    arrows = ARROW * flight["action"][step, 1:]
    axes.quiver(*followers.T, *arrows.T, color="#1f5fbf", linewidth=0.9, arrow_length_ratio=0.25)
    axes.scatter(*followers.T, s=16, color="#14213d", depthshade=False)
    axes.scatter(*(position[:1] - centre).T, s=150, marker="*", color="#c1292e", depthshade=False)
    axes.set(xlim=(-3.3, 3.3), ylim=(-3.3, 3.3), zlim=(-3.3, 3.3))
    axes.set_box_aspect((1, 1, 1), zoom=1.6)
    axes.set_axis_off()
    axes.view_init(elev=18, azim=-60)


def main(run: Path, picture: Path) -> None:
    """Draw the policy's flight above the expert's."""
    mpl.use("Agg")
    world = stored_world(RunFolder.open(run))
    expert = Reynolds.for_env(world, action=("agents", "action"))
    rows = {f"ModGNN, hears {world.comm_range:g} m far": load_policy(run), "expert, sees all": expert}
    figure, axes = plt.subplots(len(rows), len(STEPS), figsize=(12, 7.6), subplot_kw={"projection": "3d"})
    for line, (name, policy) in zip(axes, rows.items(), strict=True):
        flight = fly(policy, world)
        for panel, step in zip(line, STEPS, strict=True):
            draw(panel, flight, step)
            panel.set_title(f"{name}, {step / 48:g} s", fontsize=13, y=1.0)
    figure.subplots_adjust(0, 0, 1, 0.95, 0, 0.06)
    figure.savefig(picture, dpi=90)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("picture", type=Path, help="PNG file to write")
    main(**vars(parser.parse_args()))
