"""MAVLink microservices without I/O. They receive messages and the time, and return messages and results."""
