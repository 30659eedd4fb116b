"""Run an exported agent with NumPy and onnxruntime only.

This file has no other dependency: the export puts a copy beside ``agent.onnx`` and ``agent.json``. On the robot::

    from onnx_agent import OnnxAgent

    agent = OnnxAgent("agent")  # the folder
    while running:
        message = agent.observe(observation)  # broadcast this
        agent.receive(messages)  # the neighbours' broadcasts that arrived
        action = agent.act()
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
from numpy.typing import ArrayLike, NDArray

__all__ = ["EXPORT_VERSION", "AgentError", "OnnxAgent", "open_session"]

EXPORT_VERSION = 1  # of agent.json

Array = NDArray[Any]


class AgentError(ValueError):
    """A damaged export, data of the wrong shape, or a call out of order, in one sentence."""


class OnnxAgent:
    """One robot that runs an exported policy, like `modgnn_rl.deploy.agent.Agent` but on NumPy arrays.

    Args:
        path: the folder of the export, or ``agent.onnx`` in it. Its hash is checked.

    Attributes:
        metadata: the content of ``agent.json``: ``hops``, ``message_width``, ``control_frequency`` in Hz and more.

    Raises:
        AgentError: the export is missing or damaged.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        folder = Path(path) if Path(path).is_dir() else Path(path).parent
        self.metadata, model = _load(folder)
        try:
            self._session = open_session(model)
        except Exception as error:  # onnxruntime's exceptions have no common base class
            reason = str(error).splitlines()[0]
            raise AgentError(f"{folder / 'agent.onnx'} cannot be run by onnxruntime ({reason})") from error
        self._inputs: dict[str, tuple[list[Any], np.dtype[Any]]] = {
            name: (spec["shape"], np.dtype(spec["dtype"])) for name, spec in self.metadata["inputs"].items()
        }
        shapes = {given.name: given.shape for given in self._session.get_inputs()}
        if shapes != {name: shape for name, (shape, _) in self._inputs.items()}:
            raise AgentError(f"{folder / 'agent.json'} does not describe agent.onnx beside it; export the policy again")
        self.reset()

    def reset(self) -> None:
        """Forget everything: a reboot, or the start of an episode."""
        shape, dtype = self._inputs["messages"]
        self._messages = np.full(shape, np.nan, dtype)
        self._observed: dict[str, Array] | None = None
        self._received: dict[str, Array] | None = None

    def observe(self, observation: ArrayLike, own: Mapping[str, ArrayLike] | None = None) -> Array:
        """Start a step.

        Args:
            observation: o [F].
            own: further data of the agent, by name; ``"sensors.battery"`` for nested names.

        Returns:
            the message to broadcast now [K, D], from data up to the previous step.

        Raises:
            AgentError: called out of order, or data have the wrong shape.
        """
        if self._observed is not None:
            raise AgentError(
                "observe was called twice in a step; call observe, receive, act in turn; reset starts over"
            )
        given = dict(own or {})
        wanted = sorted(name.removeprefix("own.") for name in self._inputs if name.startswith("own."))
        if sorted(given) != wanted:
            raise AgentError(f"this agent reads {wanted} of its own data beside the observation, not {sorted(given)}")
        seen = {"observation": observation, **{f"own.{name}": value for name, value in given.items()}}
        self._observed = {name: self._array(name, value) for name, value in seen.items()}
        return self._messages.copy()

    def receive(
        self,
        messages: ArrayLike | Sequence[Array],
        *,
        weight: ArrayLike | None = None,
        feature: ArrayLike | None = None,
    ) -> None:
        """Receive the messages that arrived in this step, in any order.

        Args:
            messages: what the neighbours returned from `observe`, [M, K, D] or a sequence of [K, D]; M may be zero.
            weight: weights of their edges [M].
            feature: features of their edges [M, F].

        Raises:
            AgentError: called out of order, or data have the wrong shape.
        """
        if self._observed is None:
            raise AgentError("receive was called before observe; the order is observe, receive, act")
        if self._received is not None:
            raise AgentError("receive was called twice in a step; pass all messages at once")
        received = {"inbox": self._array("inbox", messages)}
        count = len(received["inbox"])
        for name, value in (("weight", weight), ("feature", feature)):
            rows: ArrayLike | None = [] if value is None and count == 0 and name in self._inputs else value
            if (rows is not None) != (name in self._inputs):
                need = "needs" if name in self._inputs else "was exported without"
                raise AgentError(f"this agent {need} an edge {name}")
            if rows is not None:
                received[name] = self._array(name, rows)
                if len(received[name]) != count:
                    raise AgentError(f"{count} messages came with the {name} of {len(received[name])} edges")
        self._received = received

    def act(self) -> Array:
        """End the step: return the action [O], and store the message to broadcast in the next step.

        Raises:
            AgentError: called out of order.
        """
        if self._observed is None or self._received is None:
            missing = "observe" if self._observed is None else "receive (pass [] if nothing arrived)"
            raise AgentError(f"act was called before {missing}; the order is observe, receive, act")
        feed = {**self._observed, "messages": self._messages, **self._received}
        action, self._messages = self._session.run(None, feed)
        self._observed = self._received = None
        return action

    def _array(self, name: str, value: ArrayLike | Sequence[Array]) -> Array:
        """A copy of the data of one input, checked against its shape."""
        shape, dtype = self._inputs[name]
        try:
            array = np.array(value, dtype)
        except (TypeError, ValueError) as error:
            raise AgentError(f"{name} is {shape} of {dtype}, and cannot be made of what was given: {error}") from error
        if array.shape == (0,):  # an empty list
            array = array.reshape(0, *shape[1:])
        wanted = [*array.shape[:1], *shape[1:]] if shape[:1] == ["neighbours"] else shape
        if list(array.shape) != wanted:
            raise AgentError(f"{name} is {shape}, not {list(array.shape)}")
        return array


def open_session(model: bytes) -> ort.InferenceSession:
    """Load an ONNX model to run in the calling thread; more threads would be slower at this size."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return ort.InferenceSession(model, options, providers=["CPUExecutionProvider"])


def _load(folder: Path) -> tuple[dict[str, Any], bytes]:
    """The content of agent.json, and of agent.onnx, whose hash is checked."""
    file = folder / "agent.onnx"
    try:
        text, model = (folder / "agent.json").read_bytes(), file.read_bytes()
    except OSError as error:
        raise AgentError(
            f"{folder} holds no exported agent ({error.strerror}: {error.filename}); expected agent.onnx and agent.json"
        ) from error
    try:
        metadata = json.loads(text)
        version, expected = metadata["schema_version"], metadata["files"][file.name]
    except (ValueError, KeyError, TypeError) as error:
        raise AgentError(f"{folder / 'agent.json'} is damaged; copy it again or export the policy again") from error
    if version != EXPORT_VERSION:
        raise AgentError(f"{folder} was exported in version {version}, this program runs version {EXPORT_VERSION}")
    if hashlib.sha256(model).hexdigest() != expected:
        raise AgentError(f"{file} is damaged: its SHA-256 is not the one in agent.json; copy it again or export again")
    return metadata, model
