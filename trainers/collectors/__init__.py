"""Collection of rollouts in this process or in workers, and the data they become."""
