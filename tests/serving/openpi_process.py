"""Runs in an environment of openpi-client's own, with nothing of this project: `python openpi_process.py <url> <key> <folder>`.

The folder has request_<i>.npz (arrays of openpi's nested maps, keys joined by slashes). Writes answers.npz and told.json.
"""

import json
import sys
from pathlib import Path

import numpy as np
from openpi_client import action_chunk_broker, msgpack_numpy, websocket_client_policy

url, key, folder = sys.argv[1], sys.argv[2], Path(sys.argv[3])


def read(path: Path) -> dict:
    request: dict = {"prompt": "push the button"}
    with np.load(path) as file:
        for name in file.files:
            outer, _, inner = name.partition("/")
            if inner:
                request.setdefault(outer, {})[inner] = file[name]
            else:
                request[outer] = file[name]
    return request


requests = [read(path) for path in sorted(folder.glob("request_*.npz"))]
told: dict = {}
try:
    websocket_client_policy.WebsocketClientPolicy(url, api_key="wrong" * 8)
except Exception as error:  # whatever the client raises is what its user sees
    told["wrong_key"] = f"{type(error).__name__}: {error}"

policy = websocket_client_policy.WebsocketClientPolicy(url, api_key=key)
told["metadata"] = policy.get_server_metadata()
answers = [policy.infer(request) for request in requests]
told["timings"] = [answer["server_timing"] for answer in answers]
told["reset"] = policy.infer({"endpoint": "reset"})
guided = policy.infer({**requests[0], "inference_delay": 1, "executed_steps": 2})  # after a reset: nothing to continue
again = policy.infer({**requests[1], "inference_delay": 1, "executed_steps": 2})
try:
    policy.infer({"prompt": "no images"})
except RuntimeError as error:
    told["mistake"] = str(error)

broker = action_chunk_broker.ActionChunkBroker(
    websocket_client_policy.WebsocketClientPolicy(url, api_key=key), action_horizon=4
)
steps = [broker.infer(requests[0]) for _ in range(8)]
told["broker"] = broker._policy.get_server_metadata()["session"]
told["requests"] = [int(step["request"]) for step in steps]
broker.reset()

np.savez(
    folder / "answers.npz",
    chunks=np.stack([answer["actions"] for answer in answers]),
    guided=np.stack([guided["actions"], again["actions"]]),
    steps=np.stack([step["actions"] for step in steps]),
)
(folder / "frame.bin").write_bytes(msgpack_numpy.packb(requests[0]))
(folder / "told.json").write_text(json.dumps(told))
