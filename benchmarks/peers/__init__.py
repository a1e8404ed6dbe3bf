"""Peers: against Gymnasium-Robotics, Stable-Baselines3 and the bare simulators."""
