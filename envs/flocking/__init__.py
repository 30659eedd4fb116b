"""The flocking task: quadcopters that follow a leader."""
