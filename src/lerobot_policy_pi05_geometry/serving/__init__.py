"""A checkpoint served to robots: openpi's websocket protocol, LeRobot's gRPC protocol, and a LeRobot policy that asks a server.

```
   limits               what a request may cost, and the error that a client is told of
   wire                 openpi's msgpack frames, checked before anything is allocated
   rigs                 which robot a request is of, where the checkpoint knows several
   inputs               a request in either spelling of keys -> a checked observation
   noise                the noise of a request, a function of session and request
   renaming             checkpoints that were trained with a `rename_map`
   session              what the server keeps of one robot
   engine               observations of a batch -> action chunks
   worker               the one thread that runs the engine, and the queue before it
   metadata             what a client is told first
   keys                 the key that clients must know, and which addresses need one
   admission            who may connect: key, Origin, number of sessions; /healthz
   bounded_connection   ends a client that makes the server write and does not read
   websocket_server     one session per connection
   service              a checkpoint with all of this around it
   client               the other end, for Python programs
   remote/              `--policy.type=pi05_geometry_remote`
   lerobot_wire/        LeRobot's robot_client, its pickles read without pickle
```

Nothing here is imported by the policy. Only `remote.configuration_pi05_geometry_remote` is imported with the package, since
LeRobot finds policies by it; it needs none of the optional packages.
"""
