"""The pose room: the partial point cloud of a known object to its 6-DoF pose."""
