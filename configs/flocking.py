"""Settings of the flocking environment and of its Reynolds expert."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from modgnn_rl.configs.settings import setting
from modgnn_rl.configs.task import TaskConfig
from modgnn_rl.registry import TASKS

__all__ = ["REFERENCE_SIZE", "FlockingConfig"]

REFERENCE_SIZE = 32  # the flock size to which start_radius, num_envs and agents_per_state refer


@dataclass
class FlockingConfig(TaskConfig):
    """The environment: flocks of quadcopters that follow a leader, and the gains of their Reynolds expert.

    The defaults are ``env=flocking``, in which the expert keeps flocks together; ``env=paper`` is closest to the paper.
    """

    irrelevant_to_data: ClassVar[tuple[str, ...]] = (
        "max_steps",
        "max_links",
        "compile",
        "max_distance",
        "collision_distance",
        "max_colliding",
        "on_nonfinite",
    )

    name: str = setting("flocking", "task", choices=TASKS)
    num_agents: Any = setting(
        32, "agents in a flock, including the leader; a list trains on several sizes at once", ge=1, whole=True
    )
    comm_range: float = setting(3.5, "communication range: distance within which agents hear each other (m)", gt=0)
    max_steps: int = setting(1000, "control steps after which an episode is truncated", ge=1)
    max_speed: float = setting(0.92, "target velocities are projected onto a ball of this radius (m/s)", gt=0)

    cohesion_gain: float = setting(0.06, "expert: weight C_c of the Reynolds cohesion term", ge=0)
    separation_gain: float = setting(0.8, "expert: weight C_s of the Reynolds separation term", ge=0)
    alignment_gain: float = setting(0.02, "expert: weight C_a of the Reynolds alignment term", ge=0)

    graph: str = setting(
        "matrix", "graph format: dense adjacency matrix [N, N], or edge list [2, E]", choices=("matrix", "links")
    )
    max_links: int = setting(
        64, "graph=links: capacity of the edge list, in edges per agent on average over a flock", ge=1
    )

    start: str = setting(
        "ball",
        "initial positions: uniform in a ball, on a grid, or in several balls",
        choices=("ball", "grid", "clusters"),
    )
    start_radius: float = setting(
        4.0, "radius of the initial ball for 32 agents (m); it scales with (N / 32)^(1/3)", gt=0
    )
    start_distance: float = setting(0.3, "minimum distance between agents at the start (m)", ge=0)
    start_clusters: int = setting(3, "start=clusters: number of clusters", ge=1)
    leader: str = setting(
        "noise",
        "leader trajectory: integrated noise, random waypoints, or a circle",
        choices=("noise", "waypoints", "circle"),
    )
    leader_noise: float = setting(
        0.10, "leader=noise: N(0, leader_noise^2 dt) is added to its target velocity each step (m/s^1.5)", ge=0
    )
    leader_max_speed: float = setting(
        0.8, "leader=noise: its target velocity is clipped to a ball of this radius (m/s)", gt=0
    )
    leader_speed: float = setting(0.5, "leader=waypoints or circle: its speed (m/s)", ge=0)
    leader_radius: float = setting(
        5.0, "leader=circle: radius (m); leader=waypoints: maximum distance of waypoints from the origin (m)", gt=0
    )

    physics: str = setting("torch", "physics engine", choices=("torch", "bullet"))
    control_frequency: float = setting(48.0, "control frequency (Hz)", gt=0)
    physics_substeps: int = setting(5, "physics steps per control step (5 x 48 Hz = 240 Hz)", ge=1)
    velocity_gain: float = setting(1.0, "velocity controller: proportional gain k_p (1/s)", gt=0)
    collisions: bool = setting(False, "physics=bullet: whether agents bounce off each other")
    ground: float | None = setting(None, "height of a frictionless floor (m); null: no floor")
    linear_damping: float = setting(0.0, "damping d of velocities as in Bullet, a = -d v (1 + |v|)", ge=0)
    angular_damping: float = setting(0.0, "damping d of angular velocities, same form as linear_damping", ge=0)
    drag: float = setting(0.0, "rotor drag, as a multiple of the coefficients measured for the Crazyflie", ge=0)
    motor_lag: float = setting(0.0, "time constant with which rotor thrusts follow their commands (s)", ge=0)
    compile: bool = setting(False, "compile physics, graph and expert: takes seconds at the start, then runs faster")
    on_nonfinite: str = setting(
        "stop",
        "if the state or action of an agent becomes NaN or infinite: stop with an error, or restart that flock",
        choices=("stop", "restart"),
    )

    message_loss: float = setting(
        0.0, "perturbation: probability that a message is lost, for each edge and step", ge=0, le=1
    )
    delay: int = setting(
        0, "perturbation: delay of observations, and of the messages computed from them (control steps)", ge=0
    )
    range_spread: float = setting(
        0.0,
        "perturbation: each agent is heard within comm_range (1 + x), with x ~ U(-range_spread, range_spread) sampled "
        "once per rollout",
        ge=0,
        le=1,
    )
    position_noise: float = setting(0.0, "perturbation: standard deviation of noise on observed positions (m)", ge=0)
    velocity_noise: float = setting(0.0, "perturbation: standard deviation of noise on observed velocities (m/s)", ge=0)
    dropout_rate: float = setting(
        0.0,
        "perturbation: dropout rate of followers (1/s); a dropped-out agent hovers, and neither sends nor receives",
        ge=0,
    )
    dropout_time: float = setting(2.0, "perturbation: mean duration of a dropout (s)", gt=0)
    wind: float = setting(
        0.0, "perturbation: standard deviation of wind gusts on a flock along each axis (m/s^2)", ge=0
    )
    wind_time: float = setting(1.0, "perturbation: correlation time of wind gusts (s)", gt=0)

    max_distance: float = setting(
        30.0, "an episode terminates when an agent is farther than this from the flock's centre of mass (m)", gt=0
    )
    collision_distance: float = setting(0.08, "agents closer than this collide (m; default: twice the rotor arm)", ge=0)
    crowding_distance: float = setting(0.4, "agents closer than this crowd each other (m)", gt=0)
    leader_cost: float = setting(0.1, "reward: weight of the distance to the leader (1/m)", ge=0)
    cohesion_cost: float = setting(0.05, "reward: weight of the distance to the flock's centre of mass (1/m)", ge=0)
    crowding_cost: float = setting(
        1.0, "reward: weight of (1 - d / crowding_distance)^2, where d is the distance to the nearest agent", ge=0
    )
    collision_cost: float = setting(1.0, "reward: weight of a collision with another agent", ge=0)
    alignment_cost: float = setting(
        0.1, "reward: weight of the difference between velocity and mean velocity of the flock (s/m)", ge=0
    )
    effort_cost: float = setting(
        0.02, "reward: weight of the difference between target velocity and velocity (s/m)", ge=0
    )
    max_colliding: float = setting(
        0.5, "an episode terminates when more than this fraction of the agents are in collision", gt=0, le=1
    )

    @property
    def reference_size(self) -> int:
        """The number of agents that ``trainer.num_envs`` and ``trainer.agents_per_state`` refer to."""
        return REFERENCE_SIZE

    @property
    def not_in_data(self) -> list[str]:
        """Perturbations of adjacency, observation and mask, and edge lists: a dataset holds true states."""
        names = ("message_loss", "delay", "range_spread", "position_noise", "velocity_noise", "dropout_rate")
        found = [f"{name}={getattr(self, name)}" for name in names if getattr(self, name)]
        return [*found, *([] if self.graph == "matrix" else [f"graph={self.graph}"])]

    @property
    def hides_state(self) -> bool:
        """Whether observations differ from the true state, through delay or noise."""
        return self.delay > 0 or self.position_noise > 0 or self.velocity_noise > 0

    @property
    def state_key(self) -> tuple[str, str]:
        """Key of the true positions and velocities."""
        return ("agents", "state" if self.hides_state else "observation")
