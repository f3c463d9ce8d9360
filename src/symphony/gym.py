"""Registers the environment of ``gymnasium.make("symphony.gym:symphony/Driving-v0", data="store")`` (extra "gym")."""

try:
    import gymnasium
except ImportError as error:
    raise ImportError("Gymnasium is not installed: pip install 'symphony-traffic[gym]'") from error

if "symphony/Driving-v0" not in gymnasium.registry:
    gymnasium.register("symphony/Driving-v0", entry_point="symphony.planners.gym:DrivingGym")
