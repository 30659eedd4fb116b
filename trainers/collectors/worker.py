"""What flies flocks inside a worker, and what is sent there."""

from __future__ import annotations

import io
import logging
import os
import pickle
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cloudpickle
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs.parallel import make_worker_env
from modgnn_rl.errors import InputError
from modgnn_rl.trainers.collectors.behaviour import BetaMixture
from modgnn_rl.utils.seeds import derive_seed

__all__ = ["WorkerCollector", "WorkerSpec", "packed", "weights_of"]


@dataclass
class WorkerSpec:
    """What a worker flies; sent to it when it starts.

    Attributes:
        config, num_envs, num_agents, steps, seed, device: see `modgnn_rl.trainers.collectors.local.FlockCollector`.
        behaviour: the modules that fly and label, made by `packed`.
    """

    config: FlockingConfig
    num_envs: int
    num_agents: int
    behaviour: bytes
    steps: int
    seed: int
    device: str

    def make_env(self) -> EnvBase:
        """The flocks, in the worker."""
        logging.getLogger("torchrl").setLevel(logging.WARNING)
        torch.set_num_threads(1)
        torch.manual_seed(self.seed)
        return make_worker_env(
            num_envs=self.num_envs,
            num_agents=self.num_agents,
            config=self.config,
            seed=derive_seed(self.seed, "env"),
            device=self.device,
            stagger=True,
        )

    def make_policy(self) -> TensorDictModuleBase:
        """The behaviour, in the worker; a generator in it is seeded by the name of its module's class."""
        modules = torch.load(io.BytesIO(self.behaviour), map_location=self.device, weights_only=False)
        policy = TensorDictSequential(*modules)
        for name, generator in _generators_of(policy).items():
            module = policy.get_submodule(name.rpartition(".")[0])
            generator.manual_seed(derive_seed(self.seed, type(module).__name__.lower()))
        return policy

    @property
    def options(self) -> dict[str, Any]:
        """How TorchRL's collector flies it."""
        return {
            "policy_factory": self.make_policy,
            "frames_per_batch": self.num_envs * self.steps,
            "weight_sync_schemes": {},  # weights come with each call of `fly`
            "trust_policy": True,
            "no_cuda_sync": True,
        }


class _Pickler(cloudpickle.Pickler):
    """Pickles modules that draw at random, and those of a person's own script."""

    def reducer_override(self, value: Any) -> Any:
        if isinstance(value, torch.Generator):
            return torch.Generator, (str(value.device),)
        return super().reducer_override(value)


class _PickleModule:
    """What `torch.save` asks of a module like `pickle`."""

    Pickler = _Pickler
    dumps, load, loads = cloudpickle.dumps, pickle.load, pickle.loads


def packed(behaviour: Sequence[TensorDictModuleBase]) -> bytes:
    """Modules in a form that workers understand; generators arrive with another seed.

    Raises:
        InputError: a module that cannot be sent.
    """
    buffer = io.BytesIO()
    try:
        torch.save(list(behaviour), buffer, pickle_module=_PickleModule)
    except (pickle.PicklingError, TypeError, AttributeError) as error:
        names = ", ".join(type(module).__name__ for module in behaviour)
        raise InputError(
            f"one of the modules that fly ({names}) cannot be sent to other processes ({error}); mend that, or use "
            "collector=single"
        ) from error
    return buffer.getvalue()


def weights_of(behaviour: Sequence[TensorDictModuleBase]) -> bytes:
    """The weights of modules, and whatever else is in their state, in the form that `WorkerCollector.fly` takes."""
    buffer = io.BytesIO()
    torch.save(TensorDictSequential(*behaviour).state_dict(), buffer)
    return buffer.getvalue()


class WorkerCollector(Collector):
    """The collector in a worker; each method answers with its pickled result.

    Tensors as they are would go through shared memory, and leave a file behind when the process is killed.
    """

    _carrier: TensorDict

    def fly(self, weights: bytes, seed: int) -> bytes:
        """Continue the rollouts [B, T]; they are in the memory of the CPU.

        Args:
            weights: made by `weights_of`.
            seed: for torch's global generators.
        """
        self._take_over(weights)
        torch.manual_seed(seed)
        with torch.no_grad():
            return pickle.dumps(self.next().to("cpu"))

    def state(self) -> bytes:
        """What a checkpoint holds of the rollouts."""
        carried = self._carrier.exclude("collector").flatten_keys("/")
        tensors = {"env": self.env.base_env.snapshot(), "carried": dict(carried.items())}
        tensors["generators"] = {name: generator.get_state() for name, generator in self._generators.items()}
        tensors |= {name: mixture.state() for name, mixture in self._mixtures.items()}
        return pickle.dumps({group: {key: value.cpu() for key, value in own.items()} for group, own in tensors.items()})

    def restore(self, weights: bytes, tensors: bytes) -> bytes:
        """Go on from what `state` gave."""
        self._take_over(weights)
        found = pickle.loads(tensors)
        self.env.base_env.restore(found["env"])
        carried = TensorDict(found["carried"], self._carrier.batch_size, device=self._carrier.device)
        self._carrier = self._carrier.select("collector").update(carried.unflatten_keys("/"))
        for name, generator in self._generators.items():
            generator.set_state(found["generators"][name])
        for name, mixture in self._mixtures.items():
            mixture.restore(found[name])
        return pickle.dumps(None)

    def _take_over(self, weights: bytes) -> None:
        self.policy.load_state_dict(torch.load(io.BytesIO(weights), map_location="cpu", weights_only=True))

    @property
    def _generators(self) -> dict[str, torch.Generator]:
        env = self.env.base_env
        return {"env": env.generator, "faults": env.perturbations.generator, **_generators_of(self.policy)}

    @property
    def _mixtures(self) -> dict[str, BetaMixture]:
        found = [module for module in self.policy.modules() if isinstance(module, BetaMixture)]
        return {f"mixture{number}": mixture for number, mixture in enumerate(found)}

    def whereabouts(self) -> bytes:
        """The host, and the number of the process."""
        return pickle.dumps((socket.gethostname(), os.getpid()))


def _generators_of(policy: nn.Module) -> dict[str, torch.Generator]:
    """All generators in modules, by where they are."""
    return {
        f"{name}.{key}": value
        for name, module in policy.named_modules()
        for key, value in vars(module).items()
        if isinstance(value, torch.Generator)
    }
