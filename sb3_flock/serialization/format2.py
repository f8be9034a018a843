"""Classes with the defaults of format 2, for files that SB3 itself loads: their pickles name classes by old modules."""

from __future__ import annotations

from typing import Any

from gymnasium import spaces

from sb3_flock.rl.policies import FlockPolicy, FlockSACPolicy
from sb3_flock.rl.torch_layers import FlockCNN


class FlockCNNOfFormat2(FlockCNN):
    """:class:`FlockCNN` with the defaults of its earlier module, for files that SB3 itself loads."""

    def __init__(self, observation_space: spaces.Box, features_dim: int = 128, *args: Any, **kwargs: Any) -> None:
        if len(args) < 4:
            kwargs.setdefault("layer_norm", False)
        super().__init__(observation_space, features_dim, *args, **kwargs)


class FlockPolicyOfFormat2(FlockPolicy):
    """:class:`FlockPolicy` with the defaults of its earlier module, for files that SB3 itself loads."""

    def __init__(self, *args: Any, features_extractor_class: Any = FlockCNNOfFormat2, **kwargs: Any) -> None:
        super().__init__(*args, features_extractor_class=features_extractor_class, **kwargs)


class FlockSACPolicyOfFormat2(FlockSACPolicy):
    """:class:`FlockSACPolicy` with the defaults of its earlier module, for files that SB3 itself loads."""

    def __init__(self, *args: Any, features_extractor_class: Any = FlockCNNOfFormat2, **kwargs: Any) -> None:
        super().__init__(*args, features_extractor_class=features_extractor_class, **kwargs)
