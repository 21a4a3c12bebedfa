"""Policies and agents: how they are called, loaded by name, saved with their contract, and refused where they do not fit."""

from wlr_gym.policy.agents import Agent, Policy, Training, TrainingProgress, agent_names, load_agent, load_agent_config
from wlr_gym.policy.export import Parity, export_policy, exportable, reseal, write_model_card
from wlr_gym.policy.file import camera_share, check_contract, misses_camera, needs_camera, read_contract, write_contract
from wlr_gym.policy.sources import (
    contract_of,
    environment_for,
    fed_environment,
    find_policy,
    is_policy,
    load_policy,
    make_policy,
    policy_environment,
    shipped_names,
    trained_environment,
    untrained,
)

__all__ = [
    "Agent",
    "Parity",
    "Policy",
    "Training",
    "TrainingProgress",
    "agent_names",
    "camera_share",
    "check_contract",
    "contract_of",
    "environment_for",
    "export_policy",
    "exportable",
    "fed_environment",
    "find_policy",
    "is_policy",
    "load_agent",
    "load_agent_config",
    "load_policy",
    "make_policy",
    "misses_camera",
    "needs_camera",
    "policy_environment",
    "read_contract",
    "reseal",
    "shipped_names",
    "trained_environment",
    "untrained",
    "write_contract",
    "write_model_card",
]
