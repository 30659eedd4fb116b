"""Export of policies for robots, as ``torch.export`` and ONNX files that are checked against the policy."""

from __future__ import annotations

import contextlib
import copy
import hashlib
import importlib.util
import io
import json
import logging
import os
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict.utils import NestedKey
from torch import Tensor, nn

from modgnn_rl.deploy.agent import EdgeData, check_local, edge_data, no_messages, own_data, step
from modgnn_rl.errors import InputError
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.utils.folders import write_folder

__all__ = ["NEIGHBOURS", "TOLERANCE", "Exported", "check_packages", "export_agent", "write_agent"]

NEIGHBOURS = (0, 1, 2, 7, 10, 40)  # numbers of neighbours for which the files are checked
TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-12}  # of the larger of 1 and the largest entry
PACKAGES = ("onnx", "onnxruntime", "onnxscript")
RUNTIME = Path(__file__).with_name("onnx_agent.py")

Inputs = dict[str, Tensor]


@dataclass(frozen=True)
class Exported:
    """The result of an export.

    Attributes:
        folder: holds ``agent.onnx``, ``agent.pt2``, ``agent.json`` and ``onnx_agent.py``.
        metadata: the content of ``agent.json``.
        difference: largest difference from the policy, relative to the larger of 1 and the largest entry.
    """

    folder: Path
    metadata: dict[str, Any]
    difference: float


def export_agent(
    policy: ModGNN,
    folder: str | os.PathLike[str],
    observation: Tensor,
    *,
    own: Mapping[NestedKey, Tensor] | None = None,
    edges: EdgeData | None = None,
    model: str | None = None,
    control_frequency: float | None = None,
) -> Exported:
    """Export what one agent computes in a step, `modgnn_rl.deploy.agent.step`, for any number of neighbours.

    Nothing is written unless the files compute what the policy does, to `TOLERANCE`, on a short random rollout with 0
    to 40 neighbours. `modgnn_rl.deploy.onnx_agent.OnnxAgent` runs them.

    Args:
        policy: see `modgnn_rl.deploy.agent.check_local`; a copy in evaluation mode is exported.
        folder: where the files go; it may hold an earlier export, which is replaced as a whole.
        observation: an example of an observation [F], for its width and dtype, float32 or float64.
        own: examples of the agent's own data for keyed submodules, by name [...].
        edges: edge data, as for `modgnn_rl.deploy.agent.Agent`.
        model: name of the policy, for ``agent.json``.
        control_frequency: steps a second that the policy was trained for, Hz, for ``agent.json``.

    Raises:
        InputError: packages are missing, the policy cannot run on single agents, the files would differ from it, or
            the folder cannot be written.
    """
    check_packages()
    check_local(policy)
    folder = Path(folder).absolute()
    _check_folder(folder)
    if observation.dtype not in TOLERANCE:
        raise InputError(f"an agent is exported for float32 or float64, not for observations of {observation.dtype}")
    policy = copy.deepcopy(policy).cpu().eval()
    with torch.no_grad():
        inputs = _example_inputs(policy, observation, own or {}, edge_data(policy) if edges is None else edges)
        module = _Step(policy, list(inputs))
        program, onnx_model = _trace(module, inputs)
        difference = _largest_difference(module, program, onnx_model, inputs)
    tolerance = TOLERANCE[observation.dtype]
    if not difference <= tolerance:
        raise InputError(
            f"the exported agent differs from the policy by {difference:.1e}, more than {tolerance:.0e}; a submodule "
            "does something that torch.export or ONNX cannot express, such as remembering"
        )
    with io.BytesIO() as buffer:
        torch.export.save(program, buffer)
        models = {"agent.onnx": onnx_model, "agent.pt2": buffer.getvalue()}
    metadata = _metadata(policy, module, inputs, models) | {"model": model, "control_frequency": control_frequency}
    files = {
        **models,
        "agent.json": (json.dumps(metadata, indent=2) + "\n").encode(),
        RUNTIME.name: RUNTIME.read_bytes(),
    }
    write_agent(folder, files)
    return Exported(folder, metadata, difference)


def check_packages() -> None:
    """Check that the packages of the extra ``export`` are installed.

    Raises:
        InputError: one is missing.
    """
    missing = [name for name in PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(f"exporting needs {', '.join(missing)}, not installed here: pip install 'modgnn-rl[export]'")


class _Step(nn.Module):
    """`step` of a policy with positional inputs, as ``torch.export`` needs them.

    Args:
        policy: the policy.
        names: names of the inputs: parameters of `step`, and ``own.<name>``.
    """

    def __init__(self, policy: ModGNN, names: list[str]) -> None:
        super().__init__()
        self.policy, self.names = policy, names

    def forward(self, *tensors: Tensor) -> tuple[Tensor, Tensor]:
        """Return action [O] and messages [K, D]."""
        given = dict(zip(self.names, tensors, strict=True))
        own = {tuple(name.split(".")[1:]): given.pop(name) for name in self.names if name.startswith("own.")}
        return step(self.policy, **given, own=own_data(self.policy, given["observation"], own))


def _example_inputs(
    policy: ModGNN, observation: Tensor, given: Mapping[NestedKey, Tensor], edges: EdgeData, neighbours: int = 3
) -> Inputs:
    """Inputs of a step by name, in the order in which the files take them."""
    observation = observation.cpu()
    own = {name: value.cpu() for name, value in own_data(policy, observation, given).items()}
    messages = no_messages(policy, observation, own, edges)
    inputs = {"observation": observation, "messages": messages, "inbox": messages.expand(neighbours, -1, -1).clone()}
    inputs |= {".".join(("own", *name)): value for name, value in own.items() if value is not observation}
    return inputs | edges.example(neighbours, observation)


def _shape(name: str, value: Tensor) -> list[int | str]:
    """The shape of an input; ``"neighbours"`` stands for their number."""
    shape: list[int | str] = list(value.shape)
    return ["neighbours", *shape[1:]] if name in ("inbox", "weight", "feature") else shape


def _trace(module: _Step, inputs: Inputs) -> tuple[torch.export.ExportedProgram, bytes]:
    """The step as an exported program and as an ONNX model."""
    neighbours = torch.export.Dim("neighbours", min=0)
    dynamic = tuple({0: neighbours} if "neighbours" in _shape(*item) else None for item in inputs.items())
    try:
        with _quiet():
            program = torch.export.export(module, tuple(inputs.values()), dynamic_shapes=(dynamic,))
            for node in program.graph.nodes:
                node.meta.pop("stack_trace", None)  # names folders of this machine
            # The optimiser would treat a small constant, x + 1e-8, as zero; the optimiser of onnxruntime does not.
            onnx_program = torch.onnx.export(
                program,
                input_names=list(inputs),
                output_names=["action", "next_messages"],
                dynamo=True,
                optimize=False,
                verbose=False,
            )
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[0]
        raise InputError(f"a submodule of the policy cannot be exported: {reason}") from error
    assert onnx_program is not None
    model = onnx_program.model_proto
    for part in (*model.graph.node, *model.graph.input, *model.graph.output, *model.graph.initializer):
        part.ClearField("metadata_props")  # source locations, which take most of the file
    model.graph.ClearField("value_info")
    for size in (size for given in model.graph.input for size in given.type.tensor_type.shape.dim):
        if size.HasField("dim_param"):
            size.dim_param = "neighbours"
    return program, model.SerializeToString()


def _largest_difference(
    module: _Step, program: torch.export.ExportedProgram, onnx_model: bytes, inputs: Inputs
) -> float:
    """Largest relative difference of both exports from the policy, on a random rollout; infinite where NaN differ."""
    from modgnn_rl.deploy.onnx_agent import open_session

    try:
        session = open_session(onnx_model)
    except Exception as error:  # onnxruntime's exceptions have no common base class
        raise InputError(f"onnxruntime cannot run this policy: {str(error).splitlines()[0]}") from error
    exported = program.module()
    generator = torch.Generator().manual_seed(0)
    messages, difference = inputs["messages"], 0.0
    for count in NEIGHBOURS * 2:
        feed = _random_inputs(inputs, messages, count, generator)
        expected = module(*feed.values())
        by_onnx = session.run(None, {name: value.numpy() for name, value in feed.items()})
        for found in (exported(*feed.values()), map(torch.from_numpy, by_onnx)):
            difference = max(difference, *(_difference(a, b) for a, b in zip(expected, found, strict=True)))
        messages = expected[1]
    return difference


def _random_inputs(inputs: Inputs, messages: Tensor, count: int, generator: torch.Generator) -> Inputs:
    """A random step: one neighbour holds the same as the agent, another holds fewer hops than the rest."""
    feed = dict(inputs)
    for name, value in inputs.items():
        if not name.startswith("own."):
            shape = [count if isinstance(size, str) else size for size in _shape(name, value)]
            feed[name] = torch.randn(shape, generator=generator, dtype=value.dtype)
    feed["messages"] = messages
    feed["inbox"][:1] = messages
    feed["inbox"][1:2, count % (len(messages) + 1) :] = torch.nan
    return feed


def _difference(expected: Tensor, found: Tensor) -> float:
    if expected.shape != found.shape or not torch.equal(expected.isnan(), found.isnan()):
        return float("inf")
    values = expected.nan_to_num()
    gaps = (values - found.nan_to_num()).abs()
    return float(gaps.max() / values.abs().max().clamp(min=1)) if values.numel() else 0.0


def _metadata(policy: ModGNN, module: _Step, inputs: Inputs, models: Mapping[str, bytes]) -> dict[str, Any]:
    from modgnn_rl.deploy.onnx_agent import EXPORT_VERSION

    action, messages = module(*inputs.values())
    return {
        "schema_version": EXPORT_VERSION,
        "layers": [layer.hops for layer in policy.layers],
        "hops": policy.hops,
        "message_width": messages.shape[-1],
        "observation_width": inputs["observation"].shape[-1],
        "action_width": action.shape[-1],
        "dtype": str(action.dtype).removeprefix("torch."),
        "parameters": policy.num_parameters,
        "inputs": {
            name: {"shape": _shape(name, value), "dtype": str(value.dtype).removeprefix("torch.")}
            for name, value in inputs.items()
        },
        "files": {name: hashlib.sha256(content).hexdigest() for name, content in models.items()},
    }


def _check_folder(folder: Path) -> None:
    is_ours = (folder / "agent.json").is_file() or (folder.is_dir() and not any(folder.iterdir()))
    if folder.exists() and not is_ours:
        raise InputError(f"{folder} is not an exported agent; give a folder that does not exist yet")


def write_agent(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write the files of an exported agent; an older export is replaced.

    Raises:
        InputError: the folder cannot be written; an older export is then unchanged.
    """
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with write_folder(folder, hidden=True) as temporary:
            for name, content in files.items():
                (temporary / name).write_bytes(content)
    except OSError as error:
        raise InputError(f"cannot write {folder} ({error.strerror}): choose a folder you can write to") from error


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Suppress notices of PyTorch's exporters about packages that are not needed."""
    level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)
            yield
    finally:
        logging.disable(level)
