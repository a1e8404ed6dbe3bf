"""Scripted hands, before any training and without PyTorch: what can be felt, won and grasped."""
