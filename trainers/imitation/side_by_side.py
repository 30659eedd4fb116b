"""Several policies trained at once on the same batches: their settings, metrics and run folders."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator, Mapping, Sequence

from omegaconf import OmegaConf

from modgnn_rl.configs.schema import BCConfig, TrainConfig, as_list
from modgnn_rl.errors import InputError
from modgnn_rl.tracking.checkpoint import save_checkpoint
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.trainers.common import distributed
from modgnn_rl.trainers.imitation.learner import ImitationLearner
from modgnn_rl.utils.seeds import derive_seed

__all__ = ["by_policy", "member_configs", "member_folders"]


def member_configs(config: TrainConfig) -> dict[str, TrainConfig]:
    """The settings of each policy that behaviour cloning trains at once, by name: every model, number of hops and seed.

    A single policy has the name of its model.

    Raises:
        InputError: models or hops are listed and ``init_from`` names a policy, too.
    """
    settings: BCConfig = config.trainer
    if config.init_from is not None and (settings.models, settings.hops) != (None, None):
        raise InputError(
            "trainer.models and trainer.hops name new policies, init_from an existing one; leave out one or the other"
        )
    alone = dataclasses.replace(settings, models=None, hops=None, seeds=1)
    members = {}
    for name in as_list(settings.models or config.model.name):
        for hops in as_list(config.model.hops if settings.hops is None else settings.hops):
            for seed in range(settings.seeds):
                members[f"{name}-K{hops}" + (f"-seed{seed}" if settings.seeds > 1 else "")] = dataclasses.replace(
                    config,
                    trainer=alone,
                    model=dataclasses.replace(config.model, name=name, hops=hops),
                    seed=derive_seed(config.seed, "member", seed) if seed else config.seed,
                )
    return members if len(members) > 1 else {member.model.name: member for member in members.values()}


@contextlib.contextmanager
def member_folders(
    run: RunFolder, members: Mapping[str, TrainConfig], learners: Mapping[str, ImitationLearner]
) -> Iterator[None]:
    """When training ends, also by Ctrl-C, give each of several policies its own run folder inside the run's."""

    def write() -> None:
        for name, member in members.items() if len(members) > 1 and distributed.is_first() else ():
            folder = RunFolder.create_inside(run, name, OmegaConf.to_yaml(OmegaConf.structured(member)))
            learner = learners[name]
            if learner.updates_done:  # a resumed run that stops before its first update keeps the earlier checkpoint
                policy = {"policy": learner.ema_policy.state_dict()}
                save_checkpoint(folder.checkpoints, learner.updates_done, policy, {})

    try:
        yield
    except KeyboardInterrupt:
        write()
        raise
    write()


def by_policy(names: Sequence[str], metric: str, values: Sequence[float]) -> dict[str, float]:
    """One metric of each policy; with several policies its name begins with the policy's, ``<policy>/<metric>``."""
    if len(names) == 1:
        return {metric: values[0]}
    return {f"{name}/{metric}": value for name, value in zip(names, values, strict=True)}
