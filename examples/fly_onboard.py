"""One vehicle's own computer: numpy and onnxruntime alone, with a policy from ``sb3-flock export ddpg-5v2o policy.onnx``.

The radio and the sensors are yours; here they are played by a small world of points.
"""

import json
import sys

import numpy as np
import onnxruntime

options = onnxruntime.SessionOptions()
options.intra_op_num_threads = 1  # one core is plenty
policy = onnxruntime.InferenceSession(sys.argv[1], options)
task = json.loads(policy.get_modelmeta().custom_metadata_map["sb3_flock"])

position, heading = np.array([-0.6, -0.4]), 0.0  # of this vehicle, known to no one but this world
neighbors, obstacles = np.array([[0.1, 0.0], [-0.1, 0.05]]), np.array([[-0.3, -0.2]])
waypoint = np.zeros(2)


def seen_from(place, facing, points):
    """Positions in the frame of a body there, forward is +x, left is +y [m]."""
    cos, sin = np.cos(facing), np.sin(facing)
    return (np.atleast_2d(points) - place) @ np.array([[cos, -sin], [sin, cos]])


def measured(points):
    """What the sensors give."""
    return seen_from(position, heading, points)


looks = []  # what was measured, where and facing where: only the policies with a second look need it
steps_back = round(task["motion_lag"] / task["time_step"])

for step in range(100):
    now = {"neighbors": measured(neighbors), "obstacles": measured(obstacles), "waypoint": measured(waypoint)[0]}
    looks = [*looks, (now, position, heading)][-1 - steps_back :]
    inputs = now
    if steps_back:
        before, place, facing = looks[0]
        ego_motion = np.append(seen_from(place, facing, position)[0], heading - facing)  # by odometry
        inputs = {**now, **{f"{name}_before": points for name, points in before.items()}, "moved": moved}
    (speed, turn_rate), *_ = policy.run(None, inputs)  # m/s, rad/s, to hold for one sampling period
    position = position + speed * task["time_step"] * np.array([np.cos(heading), np.sin(heading)])
    heading += turn_rate * task["time_step"]
    if step % 10 == 9:
        print(
            f"{(step + 1) * task['time_step']:4.1f} s: {np.linalg.norm(position - waypoint):.3f} m to the waypoint, ", end=""
        )
        print(f"{np.linalg.norm(neighbors - position, axis=1).min():.3f} m to a neighbor, ", end="")
        print(f"{np.linalg.norm(obstacles - position, axis=1).min():.3f} m to the obstacle")
