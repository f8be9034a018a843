"""One vehicle's own computer: numpy and onnxruntime alone, with a policy from ``sb3-flock export ddpg -o policy.onnx``.

The shipped policies have the safety filter ``announce``: exported with it, a policy keeps the separation to the neighbors by
itself. With ``--set safety_filter=off`` the file has none.

On a real vehicle the positions come from the radio and the sensors; here a small simulated world of points gives them.
"""

import json
import sys

import numpy as np
import onnxruntime

options = onnxruntime.SessionOptions()
options.intra_op_num_threads = 1  # one core is enough
policy = onnxruntime.InferenceSession(sys.argv[1], options)
task = json.loads(policy.get_modelmeta().custom_metadata_map["sb3_flock"])

position, heading = np.array([-0.6, -0.4]), 0.0  # of this vehicle; the policy does not get them
neighbors, obstacles = np.array([[0.1, 0.0], [-0.1, 0.05]]), np.array([[-0.3, -0.2]])
neighbor_headings = np.array([0.0, np.pi / 2])  # only a safety filter that knows headings needs them
waypoint = np.zeros(2)


def in_body_frame(origin, angle, points):
    """Positions in the frame of a body at ``origin`` with heading ``angle``: forward is +x, left is +y [m]."""
    cos, sin = np.cos(angle), np.sin(angle)
    return (np.atleast_2d(points) - origin) @ np.array([[cos, -sin], [sin, cos]])


def measured(points):
    """What the sensors measure."""
    return in_body_frame(position, heading, points)


history: list = []  # measurements with this vehicle's position and heading; only policies with motion channels need it
lag_steps = round(task["motion_lag"] / task["time_step"])

for step in range(100):
    now = {"neighbors": measured(neighbors), "obstacles": measured(obstacles), "waypoint": measured(waypoint)[0]}
    history = [*history, (now, position, heading)][-1 - lag_steps :]
    inputs = now
    if lag_steps:
        before, origin, angle = history[0]
        ego_motion = np.append(in_body_frame(origin, angle, position)[0], heading - angle)  # from odometry
        previous = {f"previous_{name}": points for name, points in before.items()}
        inputs = {**now, **previous, "ego_motion": ego_motion}
    safety_filter = task.get("safety_filter", "off")
    if safety_filter in ("heading", "announce"):
        inputs = {**inputs, "neighbor_headings": neighbor_headings - heading}  # NaN for a neighbor that sends none
    if (
        safety_filter == "announce"
    ):  # announce a speed, and wait for the neighbors' announcements, NaN for one that is missing
        silence = {"neighbor_announced_speeds": np.zeros(len(neighbors))}
        (announced_speed,) = policy.run(["announced_speed"], {**inputs, **silence})
        inputs = {**inputs, "neighbor_announced_speeds": np.zeros(len(neighbors))}  # these neighbors stand still
    (action,) = policy.run(["action"], inputs)
    speed, turn_rate = action  # m/s, rad/s, to hold for one sampling period
    position = position + speed * task["time_step"] * np.array([np.cos(heading), np.sin(heading)])
    heading += turn_rate * task["time_step"]
    if step % 10 == 9:
        print(
            f"{(step + 1) * task['time_step']:4.1f} s: {np.linalg.norm(position - waypoint):.3f} m to the waypoint, ", end=""
        )
        print(f"{np.linalg.norm(neighbors - position, axis=1).min():.3f} m to a neighbor, ", end="")
        print(f"{np.linalg.norm(obstacles - position, axis=1).min():.3f} m to the obstacle")
