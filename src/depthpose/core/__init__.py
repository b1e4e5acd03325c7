"""What depth and pose share: geometry, files, config, checkpoints, the training loop."""
