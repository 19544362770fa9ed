"""Training of the network: scenes from volumes, losses through the splatter, the loop and its checkpoints."""

from vvgt_cli.network.training.config import LossConfig, SceneConfig, TrainConfig

__all__ = ["LossConfig", "SceneConfig", "TrainConfig"]
