"""A shipped policy and ORCA in the same episode, as one GIF: obstacles cross the flock."""

import sys

from PIL import Image, ImageDraw, ImageSequence

from sb3_flock import load_policy, make_controller, render

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 150
policy = load_policy("flock")
scenario = policy.scenario.replace(n_vehicles=5, n_obstacles=2, obstacle_motion="crossing", max_cycles=steps)
render(policy, scenario, "ours.gif", episode=7)
render(make_controller("orca"), scenario.replace(safety_filter="off"), "orca.gif", episode=7)
frames = []
with Image.open("ours.gif") as ours, Image.open("orca.gif") as orca:
    palette = ours.copy()
    for pair in zip(ImageSequence.Iterator(ours), ImageSequence.Iterator(orca), strict=True):
        frame = Image.new("RGB", (880, 470), "white")
        for x, name, picture in zip((0, 440), ("flock, with the safety filter", "ORCA"), pair, strict=True):
            frame.paste(picture.convert("RGB").crop((100, 140, 540, 590)), (x, 20))
            ImageDraw.Draw(frame).text((x + 20, 6), name, "black", font_size=16)
        frames.append(frame.quantize(palette=palette, dither=Image.Dither.NONE))
start = len(frames) // 8
frames[start].save("beside_orca.gif", save_all=True, append_images=frames[start + 2 :: 2], duration=100, loop=0)
