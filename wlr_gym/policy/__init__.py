"""Policies and agents: how they are called, loaded by name, saved with their contract, and refused where they do not fit."""

from wlr_gym.policy.agents import Agent, Policy, Training, agent_names, load_agent, load_agent_config
from wlr_gym.policy.file import check_contract, load_policy, make_policy, read_contract, write_contract

__all__ = [
    "Agent",
    "Policy",
    "Training",
    "agent_names",
    "check_contract",
    "load_agent",
    "load_agent_config",
    "load_policy",
    "make_policy",
    "read_contract",
    "write_contract",
]
