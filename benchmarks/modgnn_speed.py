"""How fast ModGNN is: against a dense implementation, with and without its rewrites, in windows and in ensembles.

    python benchmarks/modgnn_speed.py                     # all tables, one thread
    python benchmarks/modgnn_speed.py dense               # one of dense, rewrites, memory, windows, ensembles
    MALLOC_TRIM_THRESHOLD_=-1 MALLOC_MMAP_MAX_=0 python benchmarks/modgnn_speed.py dense

The model is ModGNN-MLP with 6 inputs and hidden width 32, forward and backward pass of one environment step, 60 % of
the pairs linked. Times are medians of runs that take turns, so that a busy machine slows all alike, and of the
processor, not of the wall, with one thread; memory is what a process of its own needs at its peak beyond what it needs
before (Linux).
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import tensordict
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint
from torchrl.modules import set_recurrent_mode

from modgnn_rl import ModGNN, ModGNNLayer
from modgnn_rl.models.blocks import LATENT, mlp
from modgnn_rl.nn import aggregation, fused, graph

HIDDEN, INPUTS, OUTPUTS = 32, 6, 3
SHAPES = ((256, 32), (1, 1024))
HOPS = (1, 2, 3)
SHARE = 0.6  # of the pairs that are linked
REPETITIONS = 7

Run = Callable[[], object]


class DenseModGNN(nn.Module):
    """ModGNN-MLP as the formula is written down: every pair of agents goes through f_pre, for every hop.

    Args:
        hops: number of hops K.
    """

    def __init__(self, hops: int) -> None:
        super().__init__()
        self.f_pre = nn.ModuleList([mlp(INPUTS, HIDDEN, LATENT) for _ in range(hops + 1)])
        self.f_mid = nn.ModuleList([mlp(LATENT, HIDDEN, LATENT) for _ in range(hops + 1)])
        self.f_final = mlp(LATENT, HIDDEN, OUTPUTS)

    def forward(self, observation: Tensor, adjacency: Tensor, messages: Tensor) -> tuple[Tensor, Tensor]:
        """One step: observations [B, N, D], adjacency [B, N, N], messages [B, N, K, D] -> actions, new messages."""
        size, hops = observation.shape[1], messages.shape[2]
        adjacency = adjacency.to(observation.dtype).unsqueeze(-1)
        myself = torch.eye(size, dtype=observation.dtype).unsqueeze(-1)
        data = self.f_pre[0](observation.unsqueeze(1).expand(-1, size, -1, -1))
        total = self.f_mid[0]((data * myself).sum(2))
        sent = [observation]
        for hop in range(1, hops + 1):
            message = messages[:, :, hop - 1]
            incoming = message.unsqueeze(1) - message.unsqueeze(2)
            total = total + self.f_mid[hop]((self.f_pre[hop](incoming) * adjacency).sum(2))
            sent.append((incoming * adjacency).sum(2))
        return self.f_final(total), torch.stack(sent[:hops], 2)


def sparse_modgnn(dense: DenseModGNN) -> ModGNN:
    """The same model, with the same weights, as a `ModGNN`."""
    layer = ModGNNLayer(len(dense.f_pre) - 1, f_pre=dense.f_pre, f_mid=dense.f_mid, f_final=dense.f_final)
    return ModGNN(layer)


def random_step(flocks: int, agents: int, hops: int, share: float = SHARE) -> TensorDict:
    """Observations, graphs and messages of one step in mid-rollout."""
    generator = torch.Generator().manual_seed(0)
    linked = torch.rand(flocks, agents, agents, generator=generator) < share
    return TensorDict(
        {
            "agents": {"observation": torch.randn(flocks, agents, INPUTS, generator=generator)},
            "adjacency": linked & ~torch.eye(agents, dtype=torch.bool),
            "messages": torch.randn(flocks, agents, hops, INPUTS, generator=generator),
            "is_init": torch.zeros(flocks, 1, dtype=torch.bool),
        },
        [flocks],
    )


def both_ways(module: nn.Module, forward: Callable[[], Tensor]) -> Run:
    """A function that runs forward and backward pass."""

    def run() -> Tensor:
        module.zero_grad(set_to_none=True)
        output = forward()
        output.square().mean().backward()
        return output

    return run


def dense_and_sparse(flocks: int, agents: int, hops: int) -> tuple[Run, Run]:
    """Forward and backward pass of the dense implementation and of ours, on the same weights and data."""
    torch.manual_seed(0)
    data, dense = random_step(flocks, agents, hops), DenseModGNN(hops)
    sparse = sparse_modgnn(dense)
    inputs = data["agents", "observation"], data["adjacency"], data["messages"]
    run_dense = both_ways(dense, lambda: dense(*inputs)[0])
    return run_dense, both_ways(sparse, lambda: action_of(sparse, data))


def action_of(policy: ModGNN, data: TensorDict) -> Tensor:
    """The policy's actions; the data are left as they are."""
    return policy(data.copy())["agents", "action"]


def dense_table() -> None:
    """Print times and memory of the dense implementation and of ours."""
    header("flocks x agents, K", "dense, ms", "ours, ms", "times faster", "dense, MiB", "ours, MiB")
    for flocks, agents in SHAPES:
        for hops in HOPS:
            dense, sparse = dense_and_sparse(flocks, agents, hops)
            torch.testing.assert_close(dense(), sparse(), rtol=1e-4, atol=1e-5)
            times = in_turns({"dense": dense, "ours": sparse})
            case = (str(flocks), str(agents), str(hops))
            memory = [peak("dense", *case), peak("ours", *case)]
            print(
                f"| {flocks} x {agents}, K = {hops} | {times['dense']:.0f} | {times['ours']:.0f} "
                f"| **{times['dense'] / times['ours']:.1f}** | {memory[0]:.0f} | {memory[1]:.0f} |",
                flush=True,
            )


def rewrites_table() -> None:
    """Print what each of the rewrites is worth: times without it, relative to all of them."""
    header("without", "256 x 32, K = 1", "256 x 32, K = 3", "1 x 1024, K = 1")
    cases = [(256, 32, 1), (256, 32, 3), (1, 1024, 1)]
    runs = [dense_and_sparse(*case)[1] for case in cases]
    rows: dict[str, list[str]] = {}
    for run in runs:
        ways = {name: (lambda without=without, run=run: _within(without(), run)) for name, without in WITHOUT.items()}
        times = in_turns(ways)
        for name, value in times.items():
            rows.setdefault(name, []).append(
                f"{value:.0f} ms" if name == "nothing" else f"x {value / times['nothing']:.2f}"
            )
    for name, values in rows.items():
        print(f"| {name} | {' | '.join(values)} |")


def _within(context: contextlib.AbstractContextManager[object], run: Run) -> None:
    with context:
        run()


@contextlib.contextmanager
def patched(**values: object) -> Iterator[None]:
    """Set attributes ``module__NAME`` of the library for a while."""
    modules = {"aggregation": aggregation, "fused": fused, "graph": graph}
    targets = [(modules[key.partition("__")[0]], key.partition("__")[2], value) for key, value in values.items()]
    before = [(module, name, getattr(module, name)) for module, name, _ in targets]
    for module, name, value in targets:
        setattr(module, name, value)
    try:
        yield
    finally:
        for module, name, value in before:
            setattr(module, name, value)


class _CheckpointedReluSum:
    """What the hand-written backward pass of `fused` computes, by ``torch.utils.checkpoint``."""

    @staticmethod
    def apply(edges: graph.EdgeList, incoming: Tensor, own: Tensor | None, *weights: Tensor | None) -> Tensor:
        """Sums of the last ReLU's output over incoming edges [R, F]."""

        def of_block(receivers: slice, part: slice, incoming: Tensor, own: Tensor | None) -> Tensor:
            hidden = incoming.index_select(0, edges.sender[part])
            if own is not None:
                hidden = hidden - own.index_select(0, edges.receiver[part])
            hidden = hidden.relu()
            for weight, bias in zip(weights[::2], weights[1::2], strict=True):
                hidden = nn.functional.linear(hidden, cast(Tensor, weight), bias).relu()
            offsets = edges.offsets()[receivers] - part.start
            return nn.functional.embedding_bag(torch.arange(len(hidden)), hidden, offsets, mode="sum")

        blocks = [
            checkpoint(of_block, *block, incoming, own, use_reentrant=False, preserve_rng_state=False)
            for block in edges.blocks()
        ]
        return torch.cat(blocks)


class _NotFused:
    @staticmethod
    def fuse(*_: object) -> None:
        """Fuse nothing."""


ALL_EDGES = 1 << 40
WITHOUT: Mapping[str, Callable[[], contextlib.AbstractContextManager[object]]] = {
    "nothing": contextlib.nullcontext,
    "blocks (all edges at once)": lambda: patched(graph__BLOCK={"cpu": ALL_EDGES}),
    "hand-written backward pass (checkpointed instead)": lambda: patched(fused___ReluSum=_CheckpointedReluSum),
    "layers moved to nodes": lambda: patched(aggregation__fused=_NotFused),
    "the same, all activations stored": lambda: patched(
        aggregation__fused=_NotFused, aggregation__MAX_STORED_EDGES=ALL_EDGES
    ),
    "the same, stored, all edges at once": lambda: patched(
        aggregation__fused=_NotFused, aggregation__MAX_STORED_EDGES=ALL_EDGES, graph__BLOCK={"cpu": ALL_EDGES}
    ),
}


def windows_table() -> None:
    """Print the time of whole rollouts in recurrent mode against that of rebuilding the window of every step."""
    header("16 rollouts of 64 steps, 32 agents", "rebuilt windows, ms", "scanned, ms", "times faster")
    for hops in HOPS:
        torch.manual_seed(0)
        policy = sparse_modgnn(DenseModGNN(hops))
        step = random_step(16, 32, hops).exclude("messages")
        rollouts: Any = torch.cat([step.unsqueeze(1)] * 64, 1)
        rollouts["is_init"][:, 0] = True

        def scan(policy: ModGNN = policy, rollouts: TensorDict = rollouts) -> Tensor:
            with set_recurrent_mode(True):
                return action_of(policy, rollouts)

        def rebuild(policy: ModGNN = policy, rollouts: TensorDict = rollouts, hops: int = hops) -> Tensor:
            steps = torch.arange(hops, 64).unsqueeze(-1) + torch.arange(-hops, 1)
            wanted = torch.zeros(16 * (64 - hops), hops + 1, 32, dtype=torch.bool)
            wanted[:, -1] = True
            with set_recurrent_mode(True):
                windows = rollouts[:, steps].flatten(0, 1)
                return policy(windows, receivers=wanted)["agents", "action"][:, -1]

        torch.testing.assert_close(scan()[:, hops:].flatten(0, 1), rebuild(), rtol=1e-4, atol=1e-5)
        times = in_turns({"rebuilt": both_ways(policy, rebuild), "scanned": both_ways(policy, scan)})
        print(
            f"| K = {hops} | {times['rebuilt']:.0f} | {times['scanned']:.0f} "
            f"| **{times['rebuilt'] / times['scanned']:.1f}** |"
        )


def ensembles_table(members: int = 8) -> None:
    """Print the time of several sets of weights at once (``vmap``) against one after the other."""
    header(f"{members} sets of weights, K = 1", "loop, ms", "vmap, ms", "times faster")
    policies = [sparse_modgnn(DenseModGNN(1)) for _ in range(members)]
    weights, _ = torch.func.stack_module_state(policies)

    for flocks, agents in ((1, 4), (1, 32), (32, 32)):
        data = random_step(flocks, agents, 1)

        def loss(weights: Mapping[str, Tensor], data: TensorDict = data) -> Tensor:
            out = torch.func.functional_call(policies[0], dict(weights), (data.copy(),))
            return out["agents", "action"].square().mean()

        def at_once(loss: Callable[..., Tensor] = loss) -> object:
            return torch.func.vmap(torch.func.grad(loss))(weights)

        def in_loop(data: TensorDict = data) -> object:
            return [both_ways(policy, functools.partial(action_of, policy, data))() for policy in policies]

        times = in_turns({"loop": in_loop, "vmap": at_once})
        print(
            f"| {flocks} x {agents} | {times['loop']:.1f} | {times['vmap']:.1f} "
            f"| **{times['loop'] / times['vmap']:.1f}** |"
        )


def memory_table() -> None:
    """Print the peak memory at 4,096 agents with 20 neighbours each."""
    header("4,096 agents, 20 neighbours each, forward and backward", "MiB")
    for hops in HOPS:
        for kind in ("edges", "matrix"):
            name = {"edges": "edge list", "matrix": "dense adjacency"}[kind]
            print(f"| {name}, K = {hops} | {peak(kind, '1', '4096', str(hops)):.0f} |", flush=True)


def large_step(hops: int, *, as_edges: bool) -> Run:
    """Forward and backward pass at 4,096 agents that hear 20 others each."""
    agents, degree = 4096, 20
    generator = torch.Generator().manual_seed(0)
    receiver = torch.arange(agents).repeat_interleave(degree)
    ring = torch.arange(1, degree + 1).repeat(agents)
    sender = (receiver + ring) % agents
    data = random_step(1, 2, hops)
    data["agents"] = TensorDict({"observation": torch.randn(1, agents, INPUTS, generator=generator)}, [1])
    data["messages"] = torch.randn(1, agents, hops, INPUTS, generator=generator)
    if as_edges:
        data["adjacency"] = torch.stack((sender, receiver)).unsqueeze(0)
    else:
        adjacency = torch.zeros(1, agents, agents, dtype=torch.bool)
        adjacency[0, receiver, sender] = True
        data["adjacency"] = adjacency
    policy = sparse_modgnn(DenseModGNN(hops))
    return both_ways(policy, lambda: action_of(policy, data))


def peak(kind: str, flocks: str, agents: str, hops: str) -> float:
    """Peak memory of one case beyond what the process needed before, MiB, in a process of its own."""
    command = [sys.executable, __file__, "--peak", kind, flocks, agents, hops]
    return float(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


def measure_peak(kind: str, flocks: int, agents: int, hops: int) -> None:
    """Print the peak memory of one case, run in this process."""
    small = dense_and_sparse(2, 4, hops)
    small[0]()
    small[1]()  # what torch loads at the first use is not counted
    before = high_water()
    if kind in ("edges", "matrix"):
        run = large_step(hops, as_edges=kind == "edges")
    else:
        run = dense_and_sparse(flocks, agents, hops)[kind == "ours"]
    run()
    run()
    print((high_water() - before) / 1024)


def high_water() -> int:
    """Peak of this process's resident memory, KiB; the figure of ``getrusage`` is handed down from the parent."""
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0])


def header(first: str, *others: str) -> None:
    """Print the head of a Markdown table."""
    print(f"\n| {' | '.join((first, *others))} |\n|---|{'---:|' * len(others)}")


def in_turns(runs: Mapping[str, Run], repetitions: int = REPETITIONS) -> dict[str, float]:
    """Median times, ms, of functions that take turns: the processor's with one thread, else those on the wall."""
    clock = time.process_time if torch.get_num_threads() == 1 else time.perf_counter
    times: dict[str, list[float]] = {name: [] for name in runs}
    for repetition in range(repetitions + 1):
        for name, run in runs.items():
            begin = clock()
            run()
            if repetition:
                times[name].append(1e3 * (clock() - begin))
    return {name: statistics.median(values) for name, values in times.items()}


TABLES = {
    "dense": dense_table,
    "rewrites": rewrites_table,
    "memory": memory_table,
    "windows": windows_table,
    "ensembles": ensembles_table,
}


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("tables", nargs="*", help=f"which tables to print, of {', '.join(TABLES)}; default: all")
    parser.add_argument("--threads", type=int, default=1, help="threads of torch")
    parser.add_argument("--peak", nargs=4, metavar=("KIND", "FLOCKS", "AGENTS", "HOPS"), help="used by the tables")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if options.peak:
        kind, *numbers = options.peak
        measure_peak(kind, *map(int, numbers))
        return
    if unknown := set(options.tables) - set(TABLES):
        parser.error(f"no table is called {', '.join(sorted(unknown))}; there are {', '.join(TABLES)}")
    allocator = {
        name: value for name, value in os.environ.items() if name.startswith("MALLOC_") or name == "LD_PRELOAD"
    }
    print(
        f"torch {torch.__version__}, tensordict {tensordict.__version__}, {platform.machine()} "
        f"({torch.backends.cpu.get_cpu_capability()}), {options.threads} thread(s), allocator: {allocator or 'default'}"
    )
    for name in options.tables or TABLES:
        TABLES[name]()


if __name__ == "__main__":
    main()
