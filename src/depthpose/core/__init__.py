"""The floor: geometry, files, config, checkpoints and reports. It knows neither room."""
