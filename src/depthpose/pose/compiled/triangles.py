"""Triangles as a depth camera sees them."""

import numpy as np

from depthpose.pose.compiled import compiled


@compiled
def draw_triangles(corners_m, R, t_m, K, near_m, depth_m, face):
    """Write the depth and the number of the nearest triangle into the pixels that it covers.

    Without clipping: a triangle with a corner nearer than ``near_m`` is left out.
    """
    height, width = depth_m.shape
    u = np.empty(3)
    v = np.empty(3)
    z = np.empty(3)
    for f in range(len(corners_m)):
        for k in range(3):
            x_m, y_m, z_m = corners_m[f, k]
            x = R[0, 0] * x_m + R[0, 1] * y_m + R[0, 2] * z_m + t_m[0]
            y = R[1, 0] * x_m + R[1, 1] * y_m + R[1, 2] * z_m + t_m[1]
            z[k] = R[2, 0] * x_m + R[2, 1] * y_m + R[2, 2] * z_m + t_m[2]
            u[k] = (K[0, 0] * x + K[0, 1] * y) / z[k] + K[0, 2]
            v[k] = K[1, 1] * y / z[k] + K[1, 2]
        area = (u[1] - u[0]) * (v[2] - v[0]) - (u[2] - u[0]) * (v[1] - v[0])
        if min(z[0], z[1], z[2]) < near_m or area == 0:
            continue
        left = max(0, int(np.ceil(min(u[0], u[1], u[2]))))
        right = min(width - 1, int(np.floor(max(u[0], u[1], u[2]))))
        top = max(0, int(np.ceil(min(v[0], v[1], v[2]))))
        bottom = min(height - 1, int(np.floor(max(v[0], v[1], v[2]))))
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                # Barycentric shares, in which 1 / depth is linear.
                a = ((u[1] - column) * (v[2] - row) - (u[2] - column) * (v[1] - row)) / area
                b = ((u[2] - column) * (v[0] - row) - (u[0] - column) * (v[2] - row)) / area
                c = 1 - a - b
                if a < 0 or b < 0 or c < 0:
                    continue
                pixel_m = 1 / (a / z[0] + b / z[1] + c / z[2])
                if pixel_m < depth_m[row, column]:
                    depth_m[row, column] = pixel_m
                    face[row, column] = f
