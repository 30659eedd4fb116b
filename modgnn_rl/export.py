"""``python -m modgnn_rl.export run=<folder>``: export the policy of a run to robots."""

from __future__ import annotations

import shlex
import time
from statistics import median
from typing import TYPE_CHECKING, Any

from modgnn_rl.cli.command import run_command
from modgnn_rl.configs.schema import ExportConfig
from modgnn_rl.tracking.run_folder import RunFolder

if TYPE_CHECKING:
    from modgnn_rl.deploy.export import Exported
    from modgnn_rl.nn.modgnn import ModGNN

NEIGHBOURS = 10  # whose messages are received while the latency is measured
REPEATS = 300  # steps that are timed


def main(config: ExportConfig) -> None:
    """Export a policy as an agent that runs on a robot with numpy and onnxruntime alone.

    Examples::

        python -m modgnn_rl.export 'run=runs/<date>-<name>'
        python -m modgnn_rl.export 'run=runs/<date>-<name>' output=robot
    """
    run = RunFolder.open(config.run)  # before the heavy imports: a typing error must be reported at once
    from modgnn_rl.experiment.export import export_run

    print(report(*export_run(config, run)))


def report(exported: Exported, policy: ModGNN) -> str:
    """Describe an exported agent: size, difference from the policy, latency, and how to run it on a robot.

    Args:
        exported: what `modgnn_rl.deploy.export.export_agent` returned.
        policy: the policy it was exported from.
    """
    import torch

    from modgnn_rl.deploy.agent import Agent
    from modgnn_rl.deploy.export import TOLERANCE
    from modgnn_rl.deploy.onnx_agent import OnnxAgent

    about, dtype = exported.metadata, getattr(torch, exported.metadata["dtype"])
    observation = torch.zeros(about["observation_width"], dtype=dtype)
    generator = torch.Generator().manual_seed(0)
    messages = torch.randn(NEIGHBOURS, about["hops"], about["message_width"], generator=generator, dtype=dtype)
    eager = latency(Agent(policy), observation, messages)
    onnx = latency(OnnxAgent(exported.folder), observation.numpy(), messages.numpy())
    files = sorted(exported.folder.iterdir())
    frequency = about["control_frequency"]
    step = f"a.observe([0.0] * {len(observation)}); a.receive([]); print(a.act())"
    alone = f"from onnx_agent import OnnxAgent as A; a = A('.'); {step}"
    lines = [
        f"{about['model'] or 'The policy'}, {about['parameters']} parameters, is in {exported.folder}",
        *(f"  {file.name:<14}{file.stat().st_size / 1000:7.1f} kB" for file in files),
        f"Largest difference from the policy: {exported.difference:.1e}, at most {TOLERANCE[dtype]:.0e}",
        f"One step with {NEIGHBOURS} neighbours, median: onnxruntime {onnx:.0f} us, torch {eager:.0f} us",
        "A robot needs that folder, numpy and onnxruntime. It calls"
        + (f", {frequency:g} times a second," if frequency else ""),
        "  agent = onnx_agent.OnnxAgent('.')",
        "  message = agent.observe(observation); agent.receive(messages_of_neighbours); action = agent.act()",
        f"Next, try it without neighbours: cd {shlex.quote(str(exported.folder))} && python -c {shlex.quote(alone)}",
    ]
    return "\n".join(lines)


def latency(agent: Any, observation: Any, messages: Any) -> float:
    """Median time of one step of an agent, microseconds."""
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        agent.observe(observation)
        agent.receive(messages)
        agent.act()
        times.append(time.perf_counter() - start)
    return 1e6 * median(times)


if __name__ == "__main__":
    run_command(main, ExportConfig, "export")
