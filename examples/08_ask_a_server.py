"""A server that keeps weights and hands loaded, asked for grasps of a cloud as a robot would."""

import subprocess
import sys

import dro_grasp as dro

# A robot's own computer starts it once: dro-grasp serve --hand my_hand.urdf. Needs the extra apps.
server = subprocess.Popen([sys.executable, "-m", "dro_grasp", "serve", "--hand", "allegro", "--port", "0"],
                          stderr=subprocess.PIPE, text=True)
try:
    url = next(word for word in server.stderr.readline().split() if word.startswith("http")).rstrip(",")
    client = dro.GraspClient(url)
    cloud = dro.load_object("rubber_duck").cloud[::8]  # what a camera would see, here from all sides
    for _ in range(2):
        answer = client.predict("allegro", cloud, num=4, direction=(0, 0, -1))
        x, y, z = answer["grasps"][0]["wrist_position"]
        print(f"{len(answer['grasps'])} grasps in {answer['seconds']['total']:.1f} s; the best has its wrist at "
              f"({x:.3f}, {y:.3f}, {z:.3f}) m and score {answer['grasps'][0]['score']:.2f}")
finally:
    server.terminate()
    server.wait()
