"""LeRobot's asynchronous inference: its unmodified `robot_client` over gRPC, whose messages are pickles.

```
   pickles         the few opcodes and names that the client's messages consist of, interpreted; nothing else
   torch_storage   torch tensors inside them
   observation     what the client says of its robot, and an observation of it -> a request
   grpc_server     the four calls of the protocol, a session per client
```

This is the one place of the project that reads pickles, and it does so without the `pickle` module: see `pickles`.
"""
