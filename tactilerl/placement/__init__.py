"""Choose where a hand's few taxels go, before any training and without PyTorch."""
