"""SAC of stable-baselines3, trained on a learned reward: sac.py REWARD STEPS (the store: IRL_STORE)."""

import os
import sys

import gymnasium
from stable_baselines3 import SAC
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

import irlcli

name, steps = sys.argv[1], int(sys.argv[2])


def cart():
    """A cart of a mass that no expert had."""
    return Monitor(gymnasium.make("cart:Cart-v0", mass_scale=4.0, max_episode_steps=50))


reward = irlcli.load_reward(name, store=os.environ["IRL_STORE"])
paid = irlcli.RewardVecEnvWrapper(DummyVecEnv([cart] * 4), reward)
agent = SAC("MlpPolicy", paid, gamma=0.95, policy_kwargs={"net_arch": [64, 64]}, seed=0)
agent.learn(steps)
mean, _ = evaluate_policy(agent, cart(), n_eval_episodes=5)
print(f"SAC on the reward {name}: true return {mean:.1f} of 50 in mass=4x")
