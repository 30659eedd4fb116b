"""Every setting of modgnn_rl: one dataclass a configuration group, each field with its documentation and range.

This module imports neither torch nor TorchRL, so that the commands can refuse a bad setting at once.
Values that differ from these defaults stand in the YAML files beside this module, one file a choice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, make_dataclass
from typing import Any

from omegaconf import MISSING

from modgnn_rl.configs.settings import setting
from modgnn_rl.registry import MODELS

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
    "RunsConfig",
    "TrainConfig",
    "TrainerConfig",
    "WandbConfig",
    "as_list",
]


LOGGER_NAMES = ("none", "csv", "tensorboard", "wandb")
REFERENCE_SIZE = 32  # the flock size to which start_radius, num_envs and receivers refer


def as_list(value: Any) -> list[Any]:
    """A setting that is one value or a list of them, as a list."""
    return list(value) if isinstance(value, Sequence) and not isinstance(value, str) else [value]


@dataclass
class FlockingConfig:
    """The world: flocks of quadcopters behind a leader, and the rule that their expert flies by.

    The defaults are the well-posed preset S1; ``env=paper`` is the preset nearest to the paper (R).
    """

    num_agents: Any = setting(
        32, "agents in a flock, the leader included; a list trains on several sizes at once", ge=1, whole=True
    )
    comm_range: float = setting(3.5, "distance within which agents hear each other, m", gt=0)
    max_steps: int = setting(1000, "control steps after which an episode is truncated", ge=1)
    max_speed: float = setting(0.92, "target velocities are projected onto the ball of this radius, m/s", gt=0)

    cohesion_gain: float = setting(0.06, "expert: weight C_c of the Reynolds cohesion term", ge=0)
    separation_gain: float = setting(0.8, "expert: weight C_s of the Reynolds separation term", ge=0)
    alignment_gain: float = setting(0.02, "expert: weight C_a of the Reynolds alignment term", ge=0)

    graph: str = setting(
        "matrix", "form of the adjacency: matrix [N, N], or list of links [2, E]", choices=("matrix", "links")
    )
    max_links: int = setting(
        64, "graph=links: room in the list for this many links an agent, on average over a flock", ge=1
    )

    start: str = setting(
        "ball",
        "where agents start: uniform in a ball, on a grid, or in several balls",
        choices=("ball", "grid", "clusters"),
    )
    start_radius: float = setting(
        4.0, "radius of the starting ball of 32 agents, m; it scales with (N / 32)^(1/3)", gt=0
    )
    start_distance: float = setting(0.3, "smallest distance between two agents at the start, m", ge=0)
    start_clusters: int = setting(3, "start=clusters: number of clusters", ge=1)
    leader: str = setting(
        "noise",
        "how the leader flies: integrated noise, from one random waypoint to the next, or in a circle",
        choices=("noise", "waypoints", "circle"),
    )
    leader_noise: float = setting(
        0.10, "leader=noise: its target velocity gains N(0, leader_noise^2 dt) each step, m/s^1.5", ge=0
    )
    leader_max_speed: float = setting(
        0.8, "leader=noise: its target velocity is kept in the ball of this radius, m/s", gt=0
    )
    leader_speed: float = setting(0.5, "leader=waypoints or circle: its speed, m/s", ge=0)
    leader_radius: float = setting(
        5.0, "leader=circle: radius, m; leader=waypoints: they lie within this distance of the origin, m", gt=0
    )

    physics: str = setting("torch", "physics engine", choices=("torch", "bullet"))
    control_frequency: float = setting(48.0, "control steps a second, Hz", gt=0)
    physics_substeps: int = setting(5, "physics steps in a control step (5 x 48 Hz = 240 Hz)", ge=1)
    velocity_gain: float = setting(1.0, "velocity controller: proportional gain k_p, 1/s", gt=0)
    collisions: bool = setting(False, "whether agents bounce off each other; physics=bullet only")
    ground: float | None = setting(None, "height of a floor without friction, m; null: no floor")
    linear_damping: float = setting(0.0, "Bullet's damping d of velocities, a = -d v (1 + |v|)", ge=0)
    angular_damping: float = setting(0.0, "Bullet's damping d of angular velocities, as that of velocities", ge=0)
    drag: float = setting(0.0, "drag of the rotors, as a multiple of the Crazyflie's as measured", ge=0)
    motor_lag: float = setting(0.0, "time constant with which rotor thrusts follow their commands, s", ge=0)
    compile: bool = setting(False, "compile physics, graph and expert: seconds at the start, then faster")
    on_nonfinite: str = setting(
        "stop",
        "what happens when the state or the action of an agent is no number any more: stop with an error, or begin "
        "that flock anew",
        choices=("stop", "restart"),
    )

    message_loss: float = setting(
        0.0, "fault: probability that a message does not arrive, for each link and step", ge=0, le=1
    )
    delay: int = setting(
        0, "fault: control steps by which observations, and with them the messages made of them, are late", ge=0
    )
    range_spread: float = setting(
        0.0,
        "fault: each agent is heard within comm_range (1 + x), x uniform in +-range_spread, drawn for each rollout",
        ge=0,
        le=1,
    )
    position_noise: float = setting(0.0, "fault: standard deviation of observed positions, m", ge=0)
    velocity_noise: float = setting(0.0, "fault: standard deviation of observed velocities, m/s", ge=0)
    dropout_rate: float = setting(
        0.0, "fault: how often a follower drops out, 1/s; it hovers, and neither hears nor is heard", ge=0
    )
    dropout_time: float = setting(2.0, "fault: mean time until one that dropped out comes back, s", gt=0)
    wind: float = setting(0.0, "fault: standard deviation of the gusts that push a flock, m/s^2 along each axis", ge=0)
    wind_time: float = setting(1.0, "fault: time over which gusts change, s", gt=0)

    max_distance: float = setting(
        30.0, "a flock has diverged when an agent is farther than this from its centre of mass, m", gt=0
    )
    collision_distance: float = setting(
        0.08, "two agents closer than this touch (twice the rotor arm), m; costs reward", ge=0
    )
    crowding_distance: float = setting(0.4, "agents closer than this are in each other's way, m; costs reward", gt=0)
    leader_cost: float = setting(0.1, "reward: weight of the distance from the leader, 1/m", ge=0)
    cohesion_cost: float = setting(0.05, "reward: weight of the distance from the flock's centre of mass, 1/m", ge=0)
    crowding_cost: float = setting(
        1.0, "reward: weight of (1 - d / crowding_distance)^2, d being the distance of the nearest agent", ge=0
    )
    collision_cost: float = setting(1.0, "reward: weight of touching another agent", ge=0)
    alignment_cost: float = setting(
        0.1, "reward: weight of the difference of the velocity from the flock's mean velocity, s/m", ge=0
    )
    effort_cost: float = setting(
        0.02, "reward: weight of the difference of the target velocity from the velocity, s/m", ge=0
    )
    max_colliding: float = setting(
        0.5, "a flock has collided beyond use when more than this share of its agents touch another", gt=0, le=1
    )

    @property
    def sizes(self) -> list[int]:
        """``num_agents`` as a list."""
        return as_list(self.num_agents)

    @property
    def hides_state(self) -> bool:
        """Whether agents observe something else than their state."""
        return self.delay > 0 or self.position_noise > 0 or self.velocity_noise > 0

    @property
    def state_key(self) -> tuple[str, str]:
        """Where the true positions and velocities are."""
        return ("agents", "state" if self.hides_state else "observation")


_FLOWN_OTHERWISE = ("num_agents", "max_steps")  # settings of the evaluation
EnvOverrides = make_dataclass(
    "EnvOverrides",
    [
        (entry.name, Any, field(default=None, metadata=entry.metadata))
        for entry in fields(FlockingConfig)
        if entry.name not in _FLOWN_OTHERWISE
    ],
    namespace={"__doc__": "Settings of a world that differ from those of training; null: as in training."},
)


@dataclass
class ModelConfig:
    """The policy: one of the models of `modgnn_rl.models`."""

    name: str = setting("moment_force", "model", choices=MODELS)
    hops: int = setting(1, "communication hops K of each layer", ge=0)
    layers: int | None = setting(
        None, "layers; with several, agents hear of others over layers x hops links; null: the model's own", ge=1
    )
    hidden: int = setting(32, "width of the hidden layers", ge=1)


@dataclass
class TrainerConfig:
    """What all trainers share."""

    name: str = setting(MISSING, "trainer", choices=("bc", "dagger", "mappo"))
    num_envs: int = setting(
        32, "flocks of 32 agents flown at once; other sizes get as many agents, shared between the sizes", ge=1
    )
    agents_per_state: int = setting(
        4,
        "agents of a state of 32 that count in an update; at other sizes N, as many links: 32 / N times as many agents",
        ge=1,
    )
    ema_decay: float = setting(0.995, "decay of the moving average of the weights, which is evaluated", ge=0, le=1)
    max_grad_norm: float = setting(1.0, "gradients are clipped to this norm", gt=0)
    checkpoint_minutes: float = setting(
        1.0,
        "time between two checkpoints, min; longer where writing would take more than 1.5 % of it; 0: after each round",
        ge=0,
    )
    keep_checkpoints: int = setting(2, "checkpoints kept, beside the best policy", ge=1)
    checkpoint_data: bool = setting(
        True, "keep the data learned from in checkpoints: large, but a run that is resumed ends as if it never stopped"
    )
    on_nonfinite: str = setting(
        "stop", "when a loss or a gradient is no number: stop, or skip that update", choices=("stop", "skip")
    )


@dataclass
class ImitationConfig(TrainerConfig):
    """What behaviour cloning and DAgger share: how rollouts become data, and data become a policy."""

    stride: int = setting(2, "of the steps flown, each how-manyth becomes data", ge=1)
    capacity: int = setting(80_000, "flock states kept for each size", ge=1)
    replacement: str = setting(
        "fifo",
        "which states go when there is no more room: the oldest, or any, so that all ever seen are kept alike",
        choices=("fifo", "reservoir"),
    )
    batch_size: int = setting(256, "flock states in a batch", ge=1)
    learning_rates: list[float] = setting(
        [3e-3, 1e-3, 1e-4],
        "Adam: at the start, after the cloning updates, at the end; cosines between",
        gt=0,
        length=3,
    )
    rotate: bool = setting(
        True, "turn each state of a batch by a random rotation, unless the model is equivariant and turns with it"
    )
    hide_velocity: float = setting(0.0, "share of the states of a batch in which all velocities are hidden", ge=0, le=1)
    num_val_envs: int = setting(8, "flocks whose rollouts are kept for the validation error", ge=1)


@dataclass
class BCConfig(ImitationConfig):
    """Behaviour cloning: fit the expert on the expert's own rollouts."""

    name: str = setting("bc", "trainer", choices=("bc",))
    cloning_steps: int = setting(1000, "steps that the expert flies", ge=1)
    cloning_updates: int = setting(6000, "updates on its rollouts, shared by the sizes", ge=1)
    models: Any = setting(
        None, "models trained side by side on the same batches, a list; null: model.name", choices=MODELS
    )
    hops: Any = setting(None, "numbers of hops of each of them, a list; null: model.hops", ge=0, whole=True)
    seeds: int = setting(1, "initial weights of each of them, trained side by side", ge=1)
    noise: float = setting(0.0, "standard deviation of the noise in the actions that the expert flies, m/s", ge=0)
    dart: bool = setting(
        False, "fly in four parts, after each of which the noise becomes the policy's own error (DART)"
    )
    dataset: str | None = setting(
        None, "folder made by modgnn_rl.collect, whose rollouts are cloned; null: the expert flies num_envs flocks"
    )


@dataclass
class DAggerConfig(ImitationConfig):
    """DAgger: clone the expert a little, then fly, ask the expert, aggregate and fit, round by round."""

    name: str = setting("dagger", "trainer", choices=("dagger",))
    cloning_steps: int = setting(200, "steps that the expert flies at first", ge=1)
    cloning_updates: int = setting(400, "updates on its rollouts, shared by the sizes", ge=0)
    rounds: int = setting(80, "rounds of flying and fitting", ge=0)
    steps_per_round: int = setting(40, "steps flown in a round", ge=1)
    updates_per_round: int = setting(60, "updates in a round, shared by the sizes", ge=1)
    schedule: str = setting(
        "exponential",
        "how the expert's share falls until it flies no more",
        choices=("constant", "linear", "exponential"),
    )
    beta: float = setting(0.6, "the expert's share in the first round", ge=0, le=1)
    beta_decay: float = setting(0.6, "exponential schedule: factor between two rounds", ge=0, le=1)
    beta_rounds: int = setting(13, "round from which on the policy flies alone", ge=0)
    hold_steps: int = setting(40, "steps that the one who flies a flock keeps it", ge=1)
    gate: str = setting(
        "none",
        "let the expert fly a flock where the policy strays: by its disagreement with it, or an ensemble's spread",
        choices=("none", "disagreement", "ensemble"),
    )
    gate_threshold: float = setting(0.6, "disagreement or spread above which the expert flies, m/s", gt=0)
    ensemble: int = setting(3, "gate=ensemble: policies trained side by side, of which the first flies", ge=2)
    plateau_rounds: int = setting(
        0, "stop when the error of these many rounds is hardly below that of as many before; 0: never", ge=0
    )
    plateau_gain: float = setting(0.03, "smallest relative improvement that counts", ge=0, le=1)


@dataclass
class MAPPOConfig(TrainerConfig):
    """MAPPO: reinforcement learning from the world's reward, best of a policy that can fly already (``init_from``)."""

    name: str = setting("mappo", "trainer", choices=("mappo",))
    ema_decay: float = setting(0.99, "decay of the moving average of the weights, which is evaluated", ge=0, le=1)
    agents_per_state: int = setting(
        8,
        "agents of a state of 32 that count in an update; at other sizes N, as many links: 32 / N times as many agents",
        ge=1,
    )
    rounds: int = setting(100, "rounds of flying and improving", ge=1)
    steps_per_round: int = setting(50, "steps flown in a round", ge=2)
    critic_warmup: int = setting(10, "rounds at first in which only the critic learns", ge=0)
    epochs: int = setting(4, "passes over the rollouts of a round", ge=1)
    num_minibatches: int = setting(4, "batches that the rollouts of a round are split into, for each size", ge=1)
    window: int = setting(10, "steps of the windows from which learned messages are made anew", ge=1)
    noise: float = setting(0.3, "standard deviation of the explored actions at the start, m/s", gt=0)
    gamma: float = setting(0.99, "discount of a step", ge=0, le=0.9999)
    gae_lambda: float = setting(0.95, "lambda of the advantage estimator (GAE)", ge=0, le=1)
    clip_epsilon: float = setting(0.2, "probability ratios are clipped to 1 +- this", gt=0, le=1)
    entropy_coef: float = setting(0.0, "weight of the entropy of the actions in the objective", ge=0)
    learning_rate: float = setting(3e-4, "Adam: of the policy", gt=0)
    critic_learning_rate: float = setting(1e-3, "Adam: of the critic", gt=0)
    critic_hidden: int = setting(64, "width of the critic's networks", ge=1)
    kl_coef: float = setting(
        0.1, "weight of the divergence (KL) from the policy that training began with, in the first round", ge=0
    )
    kl_rounds: int = setting(50, "rounds over which that weight fades to zero; 0: it stays", ge=0)


@dataclass
class WandbConfig:
    """Weights & Biases, where ``logger`` names it."""

    project: str = setting("modgnn_rl", "project that the run goes into")
    entity: str | None = setting(None, "whose project: a user or a team; null: your own")
    group: str | None = setting(None, "group of runs that the run is one of; null: none")
    mode: str = setting("offline", "whether the run is sent while it trains", choices=("offline", "online", "disabled"))
    init_timeout: float = setting(8.0, "longest wait for the server at the start and at the end, s", gt=0, le=12)


@dataclass
class EvaluationConfig:
    """Rollouts that tell how good a policy is."""

    num_flocks: int = setting(100, "fresh flocks that each policy flies", ge=2)
    num_agents: Any = setting(None, "agents in a flock, or a list of sizes; null: as in training", ge=1, whole=True)
    steps: int = setting(1000, "steps of a rollout", ge=4)
    seed: int = setting(1_000_000, "seed of starts and leaders, apart from those of training", ge=0, le=2**32)


@dataclass
class CollectorConfig:
    """Which processes fly the flocks that a trainer learns from."""

    name: str = setting(
        "single",
        "who flies: this process, worker processes on this machine, or Ray, here or on a cluster",
        choices=("single", "process", "ray"),
    )
    workers: int | None = setting(
        None, "collector=process or ray: workers, among which the flocks are shared out; null: one a core", ge=1
    )
    timeout: float = setting(
        60.0, "longest wait for a worker's rollouts; one that takes longer is ended and replaced, s", gt=0
    )
    ray_address: str | None = setting(
        None, "collector=ray: address of a Ray cluster, as in 10.0.0.1:6379; null: Ray is started on this machine"
    )


@dataclass
class TrainConfig:
    """A training run."""

    env: FlockingConfig = field(default_factory=FlockingConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    trainer: Any = MISSING
    collector: CollectorConfig = field(default_factory=CollectorConfig)
    seed: int = setting(0, "fixes everything that is drawn", ge=0, le=2**32)
    name: str | None = setting(None, "name of the run; null: trainer and model")
    device: str = setting("cpu", "where to train: cpu, cuda, cuda:1")
    threads: int = setting(1, "threads of torch on the CPU; more rarely help at this size; 0: one a core", ge=0)
    runs: str = setting("runs", "folder for the run folders")
    resume: str | None = setting(
        None, "run folder of a run to go on with; its settings are taken from there, but for those given beside it"
    )
    init_from: str | None = setting(
        None, "run folder whose policy training begins with, and whose model it keeps; null: a fresh one"
    )
    logger: Any = setting("none", "dashboards to write for beside the plain files, one or a list", choices=LOGGER_NAMES)
    wandb: WandbConfig = field(default_factory=WandbConfig)
    video_rounds: int = setting(
        40, "logger=tensorboard or wandb: a film of a rollout each so many rounds; 0: none", ge=0
    )
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)


@dataclass
class CollectConfig:
    """A dataset of the expert's rollouts."""

    env: FlockingConfig = field(default_factory=FlockingConfig)
    episodes: int = setting(1000, "rollouts; more than a dataset has are added to it", ge=1)
    steps: int | None = setting(None, "steps of a rollout, none of which ends early; null: env.max_steps", ge=1)
    num_envs: int = setting(
        50, "flocks flown at once; their rollouts are held in memory, and one part of the dataset", ge=1
    )
    seed: int = setting(0, "fixes everything that is drawn", ge=0, le=2**32)
    output: str | None = setting(None, "folder of the dataset; null: datasets/<number of agents>-agents")
    device: str = setting("cpu", "where to fly: cpu, cuda, cuda:1")
    threads: int = setting(1, "threads of torch on the CPU; 0: one a core", ge=0)


@dataclass
class EvaluateConfig:
    """Evaluation of a finished run."""

    run: str = setting(MISSING, "run folder")
    checkpoint: str = setting("last", "which policy: the last, or the best while it trained", choices=("last", "best"))
    env: Any = field(default_factory=EnvOverrides)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    device: str = setting("cpu", "where to fly: cpu, cuda, cuda:1")
    threads: int = setting(1, "threads of torch on the CPU; more rarely help at this size; 0: one a core", ge=0)


@dataclass
class ExportConfig:
    """Export of a finished run's policy for robots."""

    run: str = setting(MISSING, "run folder")
    output: str | None = setting(None, "folder for the exported agent, made anew; null: agent/ in the run folder")
    threads: int = setting(1, "threads of torch where its latency is measured; 0: one a core", ge=0)


@dataclass
class ReplayConfig:
    """A rollout to look at."""

    run: str = setting(MISSING, "run folder")
    checkpoint: str = setting("last", "which policy: the last, or the best while it trained", choices=("last", "best"))
    env: Any = field(default_factory=EnvOverrides)
    others: Any = setting(None, "run folders whose policies fly the same rollout, one or a list; null: none")
    with_expert: bool = setting(True, "show the expert's rollout from the same start too; not in a film")
    num_agents: int | None = setting(None, "agents in the flock; null: as in training", ge=1)
    steps: int = setting(1000, "steps of the rollout", ge=1)
    stride: int | None = setting(
        None, "of the steps flown, each how-manyth is kept; null: each, unless agents x steps are very many", ge=1
    )
    seed: int = setting(1_000_000, "seed of start and leader", ge=0, le=2**32)
    format: str = setting(
        "html", "a page that plays the rollout, a film, or a picture of one step", choices=("html", "mp4", "svg", "png")
    )
    step: int | None = setting(None, "format=svg or png: the step that the picture shows; null: the last", ge=0)
    output: str | None = setting(None, "file to write; null: replay.<format> in the run folder")
    viewer: bool = setting(False, "watch the rollout in a browser while it is flown; needs modgnn-rl[viewer]")
    port: int = setting(8080, "viewer=true: port on this machine", ge=1, le=65535)
    device: str = setting("cpu", "where to fly: cpu, cuda, cuda:1")
    threads: int = setting(1, "threads of torch on the CPU; more rarely help at this size; 0: one a core", ge=0)


@dataclass
class RunsConfig:
    """A look at runs."""

    runs: str = setting("runs", "folder of the run folders")
    compare: Any = setting(
        None, "runs to compare, a list: folders, or parts of names that one run alone has; null: all are listed"
    )
    state: Any = setting(
        None,
        "list only runs that stand like this, one or several; null: all",
        choices=("training", "evaluating", "finished", "stopped", "failed", "killed", "unknown", "unreadable"),
    )
    sort: str = setting(
        "started",
        "order of the list: the newest, the longest or the best at its end",
        choices=("started", "updated", "seconds", "error", "reward", "validation_loss", "evaluation"),
    )
    format: str = setting("text", "how it is written", choices=("text", "markdown", "json"))


@dataclass
class ScaleConfig:
    """How large a reproduction of the paper is; the defaults are ``scale=small``."""

    name: str = setting("small", "what it is called in tables")
    episodes: int = setting(200, "rollouts of the expert to train on", ge=1)
    steps: int = setting(500, "steps of each", ge=2)
    val_episodes: int = setting(32, "further rollouts of the expert, for the validation error", ge=1)
    updates: int = setting(6000, "updates of each cloned model", ge=1)
    batch_size: int = setting(64, "flock states in a batch", ge=1)
    eval_episodes: int = setting(32, "fresh flocks that each policy flies", ge=2)
    eval_steps: int = setting(1000, "steps of a rollout", ge=4)
    sizes: list[int] = setting([16, 32, 64], "numbers of agents that each policy is flown with (Table 3)", ge=2)
    dagger_rounds: int = setting(40, "after=dagger or mappo: rounds of DAgger", ge=1)
    mappo_rounds: int = setting(60, "after=mappo: rounds of MAPPO", ge=1)
    num_envs: int = setting(16, "after=dagger or mappo: flocks flown at once", ge=1)
    study_updates: int = setting(4000, "study=communication or layers: updates of each model", ge=1)
    study_episodes: int = setting(16, "study=...: fresh flocks that each policy flies, of 32 agents or fewer", ge=2)
    study_steps: int = setting(400, "study=...: steps of a rollout", ge=4)
    study_sizes: list[int] = setting(
        [4, 8, 16, 32, 64, 128, 256, 512, 1024], "study=size: numbers of agents that each policy is flown with", ge=2
    )


@dataclass
class ReproduceConfig:
    """The paper's evaluation, and the studies beyond it."""

    env: FlockingConfig = field(default_factory=FlockingConfig)
    scale: ScaleConfig = field(default_factory=ScaleConfig)
    seeds: int = setting(1, "trainings of each model, with other initial weights and batches each", ge=1)
    after: str = setting(
        "cloning",
        "what the policies have learned from: the expert's rollouts as in the paper, then DAgger, then MAPPO",
        choices=("cloning", "dagger", "mappo"),
    )
    study: str = setting(
        "tables",
        "what is asked: the paper's tables, or kinds of communication, layers and hops at equal parameters, another "
        "communication range, faults, or flock sizes, without training again where that is possible",
        choices=("tables", "communication", "layers", "range", "faults", "size"),
    )
    models: Any = setting(
        None,
        "further models beside the paper's, your own too, a list: in the tables, and in range, faults and size; "
        "null: none",
        choices=MODELS,
    )
    hops: Any = setting([1, 2, 3], "numbers of hops of these", ge=0, whole=True)
    folder: str | None = setting(
        None, "where all goes; what is finished there is not made again; null: reproduction/<scale>"
    )
    seed: int = setting(0, "fixes everything that is drawn", ge=0, le=2**32)
    device: str = setting("cpu", "where to train and fly: cpu, cuda, cuda:1")
    threads: int = setting(1, "threads of torch on the CPU; the same command in a second terminal helps more", ge=0)
