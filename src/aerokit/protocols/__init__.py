"""MAVLink microservices without IO: messages and ``now`` in, messages and results out."""
