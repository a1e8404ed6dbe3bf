"""Run an exported policy on a hand behind a socket; here, that hand is simulated.

    tactilerl export examples/policies/handover_touch --out policy.onnx
    python examples/control_loop.py policy.onnx

At every control step the hand sends a line of JSON, what each sensor reads by its name, and gets
one back: where each joint is to go. Needs 'tactilerl[export]'; the loop itself only onnxruntime.
"""

import argparse
import json
import multiprocessing
import socket
from contextlib import closing
from typing import Any

import numpy as np
import onnxruntime


# The control loop, as it would run beside a real hand
def control(hand: socket.socket, file: str) -> None:
    """Answer what the hand sends, until it hangs up. The hand has the clock."""
    policy = onnxruntime.InferenceSession(file)
    texts = policy.get_modelmeta().custom_metadata_map
    about = {name: json.loads(text) for name, text in texts.items()}
    print(f"a control step is {about['control_dt']} s")
    # What is not a number was not read yet.
    inputs = {i.name: np.full(i.shape, np.nan, "f4") for i in policy.get_inputs()}
    outputs = [output.name for output in policy.get_outputs()]
    known = about["start"]
    for line in hand.makefile(encoding="utf-8"):
        for name, value in (known | json.loads(line)).items():
            if name in inputs:
                inputs[name][:] = value
        if missing := [name for name in about["inputs"] if np.isnan(inputs[name])]:
            raise SystemExit(f"the hand stays as it is: no reading of {missing}")
        found = dict(zip(outputs, policy.run(None, inputs), strict=True))
        known = {f"last_{name}": value for name, value in found.items()}
        targets = dict(zip(about["targets"], found["targets"].tolist(), strict=True))
        hand.sendall(json.dumps(targets).encode() + b"\n")


# The hand: yours sends what its sensors read; this one is simulated
def simulated_hand(port: int, seed: int) -> None:
    """Play one episode of a handover, and say how it ended."""
    import tactilerl

    env: Any = tactilerl.make(scene="handover")
    with socket.create_connection(("localhost", port)) as loop, closing(env):
        answers = loop.makefile(encoding="utf-8")
        obs, info = env.reset(seed=seed)
        is_over = False
        while not is_over:
            read = zip(
                env.observation_names(), obs["observation"].tolist(), strict=True
            )
            loop.sendall(json.dumps(dict(read)).encode() + b"\n")
            targets = json.loads(answers.readline())
            wanted = np.array([targets[name] for name in env.hand.actuators])
            obs, _, terminated, truncated, info = env.step_to(wanted)
            is_over = terminated or truncated
    print("success" if info["is_success"] else "no success")


# Both together
if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("policy", help="file that `tactilerl export` wrote")
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of the hand's episode"
    )
    given = parser.parse_args()
    with socket.create_server(("localhost", 0)) as server:
        server.settimeout(120)
        address = server.getsockname()[1], given.seed
        hand = multiprocessing.Process(target=simulated_hand, args=address)
        hand.start()
        with server.accept()[0] as connection:
            control(connection, given.policy)
        hand.join()
