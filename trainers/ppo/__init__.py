"""Actor, critic, loss and learner of MAPPO."""
