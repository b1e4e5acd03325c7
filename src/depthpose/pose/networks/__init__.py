"""The sparse ResUNet of directions to keypoints, its layers, and the baselines of the thesis."""
