"""Agents in files: parameters as safetensors, beside them a card in JSON that says everything else.

Some come along with the package, under the names of their worlds. Reading executes nothing: environment and method are
looked up by name among the library's own, and what does not fit is refused in one line.
"""

from __future__ import annotations

from hrlspec.agent_files.card import FORMAT, AgentFileError, Card
from hrlspec.agent_files.files import PACKAGED, AgentFile, acts, packaged_agents, read_agent, read_params, write_agent

__all__ = [
    "FORMAT",
    "PACKAGED",
    "AgentFile",
    "AgentFileError",
    "Card",
    "acts",
    "packaged_agents",
    "read_agent",
    "read_params",
    "write_agent",
]
