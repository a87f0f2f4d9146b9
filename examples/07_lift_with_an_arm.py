"""Plan a lift with an arm, and send it to a robot: here a fake one that listens at a socket. Needs the extra `arm`."""

import json
import socket
import threading
import time

import numpy as np

import dro_grasp as dro

RATE = 50.0  # targets per second; a real driver has its own
SPEED_UP = 10.0  # the fake robot is in a hurry; 1 for a real one

robot, can = dro.load_robot("xarm7_leaphand"), dro.load_object("can")
T_world_object = np.eye(4)
T_world_object[:3, 3] = 0.5, 0.1, -float(can.cloud[:, 2].min())  # on the table, which is at z = 0
plan = dro.plan(robot, can, T_world_object)
print("\n".join(plan.lines()))


def fake_robot(server: socket.socket, received: list[dict]) -> None:
    """Take one JSON object a line, as a driver would."""
    connection, _ = server.accept()
    with connection, connection.makefile() as lines:
        received.extend(json.loads(line) for line in lines)


server, received = socket.create_server(("127.0.0.1", 0)), []
listener = threading.Thread(target=fake_robot, args=(server, received))
listener.start()
with socket.create_connection(server.getsockname()) as driver:
    begin = time.monotonic()
    for point in plan.points(RATE):
        time.sleep(max(0.0, begin + point.time / SPEED_UP - time.monotonic()))
        message = {"time": point.time, "stage": point.stage, "arm": point.arm.tolist(), "hand": point.hand.tolist()}
        driver.sendall((json.dumps(message) + "\n").encode())
listener.join()
server.close()
lifted = robot.T_world_wrist(np.array(received[-1]["arm"]))[2, 3]
print(f"the robot got {len(received)} targets, the last in stage '{received[-1]['stage']}', the wrist at z = {lifted:.3f} m")
