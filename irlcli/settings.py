from __future__ import annotations
import msgspec
class PPOSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    n_envs: int = 16
    n_steps: int = 1024
    batch_size: int = 512
    n_epochs: int = 4
    learning_rate: float = 1e-3
    learning_rate_schedule: str = "constant"
    clip_range: float = 0.2
    clip_range_schedule: str = "constant"
    gamma: float = 0.999
    gae_lambda: float = 0.98
    ent_coef: float = 0.01
    vf_coef: float = 0.5
    max_grad_norm: float = 0.5
    net_arch: tuple[int, ...] = (64, 64)
    activation: str = "tanh"
    ortho_init: bool = True
    rollouts_per_round: int = 1
