"""Settings of the trainers: one dataclass each, and what they share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from omegaconf import MISSING

from modgnn_rl.configs.settings import setting
from modgnn_rl.registry import MODELS, TRAINERS

__all__ = ["BCConfig", "DAggerConfig", "ImitationConfig", "MAPPOConfig", "TrainerConfig"]


@dataclass
class TrainerConfig:
    """Settings that all trainers share."""

    name: str = setting(MISSING, "trainer", choices=TRAINERS)
    num_envs: int = setting(
        32,
        "environments rolled out in parallel, with the first of env.num_agents (flocking: with 32); the same number of "
        "agents is split evenly among several numbers",
        ge=1,
    )
    agents_per_state: int = setting(
        4,
        "agents of each state that enter the loss, with the first of env.num_agents (flocking: with 32); with N times "
        "as many agents 1/N of it, so that the edges are as many",
        ge=1,
    )
    ema_decay: float = setting(
        0.995, "decay of the exponential moving average (EMA) of the weights, which is the policy evaluated", ge=0, le=1
    )
    max_grad_norm: float = setting(1.0, "maximum gradient norm, for clipping", gt=0)
    checkpoint_minutes: float = setting(
        1.0,
        "time between checkpoints (min); longer if writing them would take over 1.5 % of the time; 0: after each round",
        ge=0,
    )
    keep_checkpoints: int = setting(2, "number of checkpoints to keep, besides the best policy", ge=1)
    checkpoint_data: bool = setting(
        True, "store the training data in checkpoints: large, but a resumed run ends exactly like an uninterrupted one"
    )
    on_nonfinite: str = setting(
        "stop",
        "if a loss or gradient becomes NaN or infinite: stop with an error, or skip that update",
        choices=("stop", "skip"),
    )


@dataclass
class ImitationConfig(TrainerConfig):
    """Settings that behaviour cloning and DAgger share: which rollouts become data, and how the policy is fitted."""

    stride: int = setting(2, "keep every n-th step for training", ge=1)
    capacity: int = setting(80_000, "replay buffer size, in flock states for each flock size", ge=1)
    replacement: str = setting(
        "fifo",
        "which states a full buffer drops: the oldest (fifo), or random ones, so that all states seen are kept with "
        "equal probability (reservoir)",
        choices=("fifo", "reservoir"),
    )
    batch_size: int = setting(256, "flock states per batch", ge=1)
    learning_rates: list[float] = setting(
        [3e-3, 1e-3, 1e-4],
        "Adam learning rate at the start, after the cloning updates, and at the end; cosine-annealed in between",
        gt=0,
        length=3,
    )
    rotate: bool = setting(True, "augment: rotate each state of a batch at random; skipped for equivariant models")
    hide_velocity: float = setting(
        0.0, "augment: fraction of the states of a batch whose velocities are all hidden", ge=0, le=1
    )
    num_val_envs: int = setting(8, "flocks whose rollouts are kept for the validation loss", ge=1)


@dataclass
class BCConfig(ImitationConfig):
    """Behaviour cloning: fit the expert's actions on the expert's own rollouts."""

    name: str = setting("bc", "trainer", choices=TRAINERS)
    cloning_steps: int = setting(1000, "steps of each expert rollout", ge=1)
    cloning_updates: int = setting(6000, "updates on the expert's rollouts, in total over flock sizes", ge=1)
    models: Any = setting(
        None, "models to train side by side on the same batches, a list; null: model.name", choices=MODELS
    )
    hops: Any = setting(
        None, "numbers of hops to train each of these models with, a list; null: model.hops", ge=0, whole=True
    )
    seeds: int = setting(1, "initialisations of each of these models to train", ge=1)
    noise: float = setting(0.0, "standard deviation of the noise added to the expert's actions (m/s)", ge=0)
    dart: bool = setting(
        False, "collect in four parts, and after each set the noise level to the policy's current error (DART)"
    )
    dataset: str | None = setting(
        None, "dataset folder written by modgnn_rl.collect; null: roll out the expert in num_envs flocks"
    )


@dataclass
class DAggerConfig(ImitationConfig):
    """DAgger: clone the expert briefly, then each round collect rollouts, label them with the expert, and fit."""

    name: str = setting("dagger", "trainer", choices=TRAINERS)
    cloning_steps: int = setting(200, "steps of the expert rollouts before the first round", ge=1)
    cloning_updates: int = setting(400, "updates on these rollouts, in total over flock sizes", ge=0)
    rounds: int = setting(80, "number of rounds", ge=0)
    steps_per_round: int = setting(40, "environment steps per round", ge=1)
    updates_per_round: int = setting(60, "updates per round, in total over flock sizes", ge=1)
    schedule: str = setting(
        "exponential", "how beta decreases over the rounds", choices=("constant", "linear", "exponential")
    )
    beta: float = setting(0.6, "probability that the expert acts, in the first round", ge=0, le=1)
    beta_decay: float = setting(0.6, "schedule=exponential: factor on beta from one round to the next", ge=0, le=1)
    beta_rounds: int = setting(13, "rounds after which beta is 0: from then on the policy acts alone", ge=0)
    hold_steps: int = setting(40, "steps for which the acting policy of a flock, expert or learner, is held", ge=1)
    gate: str = setting(
        "none",
        "let the expert take over a flock when the policy disagrees with it, or when an ensemble disagrees",
        choices=("none", "disagreement", "ensemble"),
    )
    gate_threshold: float = setting(
        0.6, "disagreement, or standard deviation of the ensemble, above which the expert acts (m/s)", gt=0
    )
    ensemble: int = setting(3, "gate=ensemble: number of policies trained side by side, the first of which acts", ge=2)
    plateau_rounds: int = setting(
        0,
        "early stopping: rounds over which the error is averaged and compared with as many before; 0: never stop early",
        ge=0,
    )
    plateau_gain: float = setting(
        0.03, "early stopping: smallest relative decrease of the error that counts as an improvement", ge=0, le=1
    )


@dataclass
class MAPPOConfig(TrainerConfig):
    """MAPPO: reinforcement learning from the environment's reward, best from a pretrained policy (``init_from``)."""

    name: str = setting("mappo", "trainer", choices=TRAINERS)
    ema_decay: float = setting(
        0.99, "decay of the exponential moving average (EMA) of the weights, which is the policy evaluated", ge=0, le=1
    )
    agents_per_state: int = setting(
        8,
        "agents of each state that enter the loss, with the first of env.num_agents (flocking: with 32); with N times "
        "as many agents 1/N of it, so that the edges are as many",
        ge=1,
    )
    rounds: int = setting(100, "number of rounds", ge=1)
    steps_per_round: int = setting(50, "environment steps per round", ge=2)
    critic_warmup: int = setting(10, "initial rounds in which only the critic is trained", ge=0)
    epochs: int = setting(4, "passes over the rollouts of a round", ge=1)
    num_minibatches: int = setting(4, "minibatches per pass and flock size", ge=1)
    window: int = setting(10, "steps per window in which learned messages are recomputed", ge=1)
    noise: float = setting(0.3, "initial standard deviation of the actions, for exploration (m/s)", gt=0)
    gamma: float = setting(0.99, "discount factor per step", ge=0, le=0.9999)
    gae_lambda: float = setting(0.95, "lambda of generalised advantage estimation (GAE)", ge=0, le=1)
    clip_epsilon: float = setting(0.2, "PPO: probability ratios are clipped to 1 +- clip_epsilon", gt=0, le=1)
    entropy_coef: float = setting(0.0, "weight of the entropy bonus", ge=0)
    learning_rate: float = setting(3e-4, "Adam learning rate of the policy", gt=0)
    critic_learning_rate: float = setting(1e-3, "Adam learning rate of the critic", gt=0)
    critic_hidden: int = setting(64, "width of the critic's hidden layers", ge=1)
    kl_coef: float = setting(0.1, "weight, in the first round, of the KL divergence from the initial policy", ge=0)
    kl_rounds: int = setting(50, "rounds over which kl_coef decays to zero; 0: it stays constant", ge=0)
