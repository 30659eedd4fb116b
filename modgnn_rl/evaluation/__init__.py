"""Rollouts of policies, their metrics, and statistics over episodes."""
