"""``python -m modgnn_rl.collect episodes=1000``: the expert's rollouts as a dataset to keep."""

from __future__ import annotations

from modgnn_rl.cli.command import run_command
from modgnn_rl.configs.schema import CollectConfig


def main(config: CollectConfig) -> None:
    """Fly the expert and write its rollouts to a dataset that trainer=bc reads; started again, it goes on.

    Examples::

        python -m modgnn_rl.collect episodes=100 steps=500
        python -m modgnn_rl.collect env=paper env.compile=true threads=2
        python -m modgnn_rl.collect env.num_agents=16 output=datasets/small-flocks
    """
    from modgnn_rl.data.collect import collect, report

    print(report(collect(config)))


if __name__ == "__main__":
    run_command(main, CollectConfig, "collect")
