"""A run: its configuration, training, folder and files, and how good its policy is."""
