"""Every setting of modgnn_rl: one dataclass for each configuration group, each field with its documentation and range.

This is the one place to import settings from. It imports neither torch nor TorchRL, so that a command refuses a bad
setting at once. Presets, which set other values than these defaults, are the YAML files beside this module.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from omegaconf import MISSING

from modgnn_rl.configs.flocking import REFERENCE_SIZE, FlockingConfig
from modgnn_rl.configs.settings import as_list, group, overrides_of, setting
from modgnn_rl.configs.task import TaskConfig
from modgnn_rl.configs.trainers import BCConfig, DAggerConfig, ImitationConfig, MAPPOConfig, TrainerConfig
from modgnn_rl.registry import MODELS, TASKS, TRAINERS

__all__ = [
    "REFERENCE_SIZE",
    "BCConfig",
    "CollectConfig",
    "CollectorConfig",
    "DAggerConfig",
    "EnvOverrides",
    "EvaluateConfig",
    "EvaluationConfig",
    "ExportConfig",
    "FlockingConfig",
    "ImitationConfig",
    "MAPPOConfig",
    "ModelConfig",
    "ReplayConfig",
    "ReproduceConfig",
    "RunsConfig",
    "ScaleConfig",
    "TaskConfig",
    "TrainConfig",
    "TrainerConfig",
    "WandbConfig",
    "as_list",
]

DEVICE_HELP = "torch device: cpu, cuda, cuda:1"
THREADS_HELP = "CPU threads of torch; more than one rarely helps at these sizes; 0: one per core"
EnvOverrides = overrides_of(FlockingConfig)  # a command replaces it by that of the run's task
CHECKPOINT_HELP = "policy to load: the last one, or the best one seen during training"


@dataclass
class ModelConfig:
    """The policy: one of the models in `modgnn_rl.models`."""

    name: Any = setting(None, "model; null: the task's default", choices=MODELS)
    hops: int = setting(1, "communication hops K per layer", ge=0)
    layers: int | None = setting(
        None, "layers L; the receptive field is L x K hops; null: the model's own default", ge=1
    )
    hidden: int = setting(32, "width of the hidden layers", ge=1)


@dataclass
class WandbConfig:
    """Weights & Biases, used if ``logger`` includes wandb."""

    project: str = setting("modgnn_rl", "project")
    entity: str | None = setting(None, "user or team that owns the project; null: your default entity")
    group: str | None = setting(None, "group of the run; null: none")
    mode: str = setting("offline", "whether metrics are sent while training", choices=("offline", "online", "disabled"))
    init_timeout: float = setting(
        8.0, "maximum time to wait for the server at the start and at the end (s)", gt=0, le=12
    )


@dataclass
class EvaluationConfig:
    """Rollouts on which policies are evaluated."""

    num_flocks: int = setting(100, "episodes per policy, with initial states unseen in training", ge=2)
    num_agents: Any = setting(None, "agents in a flock, or a list of sizes; null: as in training", ge=1, whole=True)
    steps: int | None = setting(None, "steps per episode; null: env.max_steps", ge=4)
    seed: int = setting(
        1_000_000, "random seed of the initial states, independent of those of training", ge=0, le=2**32
    )


@dataclass
class CollectorConfig:
    """Which processes collect the rollouts that a trainer learns from."""

    name: str = setting(
        "single",
        "where rollouts are collected: in this process, in worker processes on this machine, or by Ray",
        choices=("single", "process", "ray"),
    )
    workers: int | None = setting(
        None, "collector=process or ray: number of workers, which share the flocks; null: one per core", ge=1
    )
    timeout: float = setting(
        60.0, "maximum time for a worker's rollouts; longer ones are ended and replaced (seconds)", gt=0
    )
    ray_address: str | None = setting(
        None, "collector=ray: address of a Ray cluster, as in 10.0.0.1:6379; null: start Ray on this machine"
    )


@dataclass
class TrainConfig:
    """A training run."""

    env: TaskConfig = group(TASKS, TaskConfig, default=FlockingConfig)
    model: ModelConfig = group(MODELS, ModelConfig)
    trainer: Any = group(TRAINERS, TrainerConfig, required=True)
    collector: CollectorConfig = field(default_factory=CollectorConfig)
    seed: int = setting(0, "random seed", ge=0, le=2**32)
    name: str | None = setting(None, "name of the run; null: trainer and model")
    device: str = setting("cpu", DEVICE_HELP)
    threads: int = setting(1, THREADS_HELP, ge=0)
    runs: str = setting("runs", "folder in which run folders are created")
    resume: str | None = setting(
        None, "run folder of a run to resume; its settings are kept, except those given on the command line"
    )
    init_from: str | None = setting(
        None, "run folder whose policy and model training starts from; null: a newly initialised policy"
    )
    logger: Any = setting(
        "none",
        "loggers besides the plain files, one or a list",
        choices=("none", "csv", "tensorboard", "wandb"),
    )
    wandb: WandbConfig = field(default_factory=WandbConfig)
    video_rounds: int = setting(40, "logger=tensorboard or wandb: log a rollout video every N rounds (0: never)", ge=0)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)


@dataclass
class CollectConfig:
    """A dataset of expert rollouts."""

    env: TaskConfig = group(TASKS, TaskConfig, default=FlockingConfig)
    episodes: int = setting(1000, "rollouts in the dataset; an existing dataset is extended to this number", ge=1)
    steps: int | None = setting(None, "steps per rollout, none of which ends early; null: env.max_steps", ge=1)
    num_envs: int = setting(
        50, "flocks rolled out in parallel; held in memory together, and written as one part of the dataset", ge=1
    )
    seed: int = setting(0, "random seed", ge=0, le=2**32)
    output: str | None = setting(None, "dataset folder; null: datasets/<number of agents>-agents")
    device: str = setting("cpu", DEVICE_HELP)
    threads: int = setting(1, "CPU threads of torch; 0: one per core", ge=0)


@dataclass
class EvaluateConfig:
    """Evaluation of a finished run."""

    run: str = setting(MISSING, "run folder")
    checkpoint: str = setting("last", CHECKPOINT_HELP, choices=("last", "best"))
    env: Any = field(default_factory=EnvOverrides)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    device: str = setting("cpu", DEVICE_HELP)
    threads: int = setting(1, THREADS_HELP, ge=0)


@dataclass
class ExportConfig:
    """Export of a finished run's policy to robots."""

    run: str = setting(MISSING, "run folder")
    output: str | None = setting(
        None, "folder of the exported agent, replaced if it exists; null: agent/ in the run folder"
    )
    threads: int = setting(1, "CPU threads of torch while latency is measured; 0: one per core", ge=0)


@dataclass
class ReplayConfig:
    """A recorded rollout of a finished run's policy."""

    run: str = setting(MISSING, "run folder")
    checkpoint: str = setting("last", CHECKPOINT_HELP, choices=("last", "best"))
    env: Any = field(default_factory=EnvOverrides)
    others: Any = setting(
        None, "run folders whose policies are replayed from the same initial state, one or a list; null: none"
    )
    with_expert: bool = setting(True, "replay the expert from the same initial state, too (not in videos)")
    num_agents: int | None = setting(None, "agents in the flock; null: as in training", ge=1)
    steps: int = setting(1000, "steps of the rollout", ge=1)
    stride: int | None = setting(
        None, "keep every n-th step for the replay; null: every step, unless agents x steps is very large", ge=1
    )
    seed: int = setting(1_000_000, "random seed of the initial state", ge=0, le=2**32)
    format: str = setting(
        "html",
        "output: a web page that plays the rollout, a video, or an image of one step",
        choices=("html", "mp4", "svg", "png"),
    )
    step: int | None = setting(None, "format=svg or png: step to show; null: the last", ge=0)
    output: str | None = setting(None, "output file; null: replay.<format> in the run folder")
    viewer: bool = setting(False, "watch the rollout live in a browser; needs modgnn-rl[viewer]")
    port: int = setting(8080, "viewer=true: local port", ge=1, le=65535)
    device: str = setting("cpu", DEVICE_HELP)
    threads: int = setting(1, THREADS_HELP, ge=0)


@dataclass
class RunsConfig:
    """A list or a comparison of runs."""

    runs: str = setting("runs", "folder that contains the run folders")
    compare: Any = setting(
        None, "runs to compare, a list of run folders or of unique parts of their names; null: list all runs"
    )
    state: Any = setting(
        None,
        "list only runs in this state, or in one of several; null: all",
        choices=("training", "evaluating", "finished", "stopped", "failed", "killed", "unknown", "unreadable"),
    )
    sort: str = setting(
        "started",
        "order of the list: newest, longest or best run last",
        choices=("started", "updated", "seconds", "error", "reward", "validation_loss", "evaluation"),
    )
    format: str = setting("text", "output format", choices=("text", "markdown", "json"))


@dataclass
class ScaleConfig:
    """Size of a reproduction of the paper; the defaults are ``scale=small``."""

    name: str = setting("small", "name in tables")
    episodes: int = setting(200, "expert rollouts to train on", ge=1)
    steps: int = setting(500, "steps per expert rollout", ge=2)
    val_episodes: int = setting(32, "additional expert rollouts for the validation loss", ge=1)
    updates: int = setting(6000, "updates per cloned model", ge=1)
    batch_size: int = setting(64, "flock states per batch", ge=1)
    eval_episodes: int = setting(32, "evaluation episodes per policy", ge=2)
    eval_steps: int = setting(1000, "steps per evaluation episode", ge=4)
    sizes: list[int] = setting([16, 32, 64], "numbers of agents at which each policy is evaluated (Table 3)", ge=2)
    dagger_rounds: int = setting(40, "after=dagger or mappo: rounds of DAgger", ge=1)
    mappo_rounds: int = setting(60, "after=mappo: rounds of MAPPO", ge=1)
    num_envs: int = setting(16, "after=dagger or mappo: flocks rolled out in parallel", ge=1)
    study_updates: int = setting(4000, "study=communication or layers: updates per model", ge=1)
    study_episodes: int = setting(16, "study=...: evaluation episodes per policy, at 32 agents or fewer", ge=2)
    study_steps: int = setting(400, "study=...: steps per evaluation episode", ge=4)
    study_sizes: list[int] = setting(
        [4, 8, 16, 32, 64, 128, 256, 512, 1024], "study=size: numbers of agents at which each policy is evaluated", ge=2
    )


@dataclass
class ReproduceConfig:
    """The paper's evaluation, and the studies beyond it."""

    env: TaskConfig = group(TASKS, TaskConfig, default=FlockingConfig)
    scale: ScaleConfig = field(default_factory=ScaleConfig)
    seeds: int = setting(1, "training runs per model, with different initial weights and batches", ge=1)
    after: str = setting(
        "cloning",
        "last training stage of the policies: behaviour cloning as in the paper, then DAgger, then MAPPO",
        choices=("cloning", "dagger", "mappo"),
    )
    study: str = setting(
        "tables",
        "the paper's tables, or a study of: kinds of communication; layers and hops at equal parameters; communication "
        "range; perturbations (faults); flock size. Trained policies are reused where possible",
        choices=("tables", "communication", "layers", "range", "faults", "size"),
    )
    models: Any = setting(
        None,
        "models to add to the paper's, including your own, a list: in study=tables, range, faults and size; null: none",
        choices=MODELS,
    )
    hops: Any = setting([1, 2, 3], "numbers of hops of the added models", ge=0, whole=True)
    folder: str | None = setting(
        None, "output folder; finished jobs found there are not repeated; null: reproduction/<scale>"
    )
    seed: int = setting(0, "random seed", ge=0, le=2**32)
    device: str = setting("cpu", DEVICE_HELP)
    threads: int = setting(
        1, "CPU threads of torch; running the same command in a second terminal helps more; 0: one per core", ge=0
    )
