"""Many vehicles as one: actions on all of them, policies for failures, formations, shows."""
