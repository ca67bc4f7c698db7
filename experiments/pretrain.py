"""``python -m experiments.pretrain``: trains the agents that come along, writes their files, and the page about them.

An agent whose card has the settings that its flags give now is left alone: without the card it is made again. What was
stopped goes on where it stopped.
"""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Sequence
from pathlib import Path

import jax

from hrlspec.agent_files import PACKAGED, AgentFile, AgentFileError, packaged_agents, read_agent
from hrlspec.config import Checked, setting
from hrlspec.evaluation.results import interval_from_json
from hrlspec.run.cli import call
from hrlspec.run.commands import run
from hrlspec.run.commands.export import export
from hrlspec.run.console import PlainConsole
from hrlspec.run.errors import UserError
from hrlspec.run.experiment import Experiment, experiment_of
from hrlspec.run.flags import parse_flags
from hrlspec.run.folder import holds_run
from hrlspec.run.run_flags import experiments_of, parse_run
from hrlspec.run.signals import leave

AGENTS: dict[str, tuple[str, ...]] = {
    name: ("--env", name, "--seed", "0")
    for name in (
        *("letter", "letter12", "walk", "flatworld", "zone", "zone-nm"),
        *("zone-jaxolotl", "zone-nm-jaxolotl", "conveyor-simple-8"),
    )
}
"""The flags of the run that makes each, by its name."""
# Two chains need no larger network, and whoever installs the package loads all agents.
AGENTS["conveyor-simple-8"] += ("--config.network.encoder-mlp", "64")
PAGE = Path("docs/pretrained.md")
_MARK = "<!-- written by python -m experiments.pretrain -->\n"


@dataclasses.dataclass(frozen=True)
class PretrainFlags(Checked):
    """Trains the agents that come along as far as they are missing, writes their files, and the page about them."""

    only: tuple[str, ...] = ()
    """Agents, such as letter or walk; all if not given."""
    work: Path = Path("runs/pretrained")
    """Run folders, one for each."""
    tasks: int = setting(200, least=1)
    """Tasks of each test suite, at most as many as it has; 10 layouts for each."""
    dry_run: bool = False
    """Only say what would be run."""


def main(argv: Sequence[str], *, program: str = "hrlspec pretrain") -> None:
    """The command line.

    Args:
        argv: the arguments.
        program: what to call it in messages.

    Raises:
        UserError: bad usage, or a run folder holds a run with other settings.
        Interrupted: stopped by a signal; the run has saved what it did.
        SystemExit: with a message, when training diverged.
    """
    flags = parse_flags(PretrainFlags, argv, program=program)
    for name in flags.only:
        if name not in AGENTS:
            raise UserError(f"--only {name}: there is no such agent, expected some of: {', '.join(AGENTS)}")
    missing = [name for name in flags.only or AGENTS if not _is_current(name, flags.work)]
    console = PlainConsole(stderr=True)
    console.say(f"{len(flags.only or AGENTS)} agents, {len(missing)} of them missing")
    if flags.dry_run:
        for name in missing:
            print("python -m experiments.run", *_command(name, flags.work))
        return
    made = [_made(name, flags, console) for name in missing]
    # All at the end: the commit that a run or an evaluation names must not be one with changes.
    for file in made:
        for part in (file, file.with_suffix(".json")):
            shutil.copyfile(part, PACKAGED / part.name)
    head, _, _ = PAGE.read_text(encoding="utf-8").partition(_MARK)
    PAGE.write_text(head + _MARK + tables([read_agent(name) for name in packaged_agents()]), encoding="utf-8")
    console.say(f"written: {PAGE}")


def tables(files: Sequence[AgentFile]) -> str:
    """What agents are and what they achieve, in Markdown."""
    lines = ["", "| agent | method, recipe, seed | steps | file | commit |", "|---|---|---|---|---|"]
    for file in files:
        config, commit = file.card.config, str(file.card.trained["commit"])
        origin = f"{config['method']}, {config['recipe']}, {config['seed']}"
        size = f"{file.path.stat().st_size / 2**20:.2f} MiB"
        lines.append(f"| `{file.path.stem}` | {origin} | {file.card.env_steps:,} | {size} | {commit[:7]} |")
    lines += ["", "| agent | test suite | episodes | success [95 %] | at least | SPL |", "|---|---|---|---|---|---|"]
    for file in files:
        for suite, score in file.card.results.items():
            rate, spl = (interval_from_json(name, score) for name in ("success_rate", "spl"))
            known = "not known" if score["spl"] is None else spl
            least = f"{file.card.success_at_least[suite]:.3f}"
            lines.append(f"| `{file.path.stem}` | {suite} | {score['episodes']:,} | {rate} | {least} | {known} |")
    return "\n".join(lines) + "\n"


def _command(name: str, work: Path) -> list[str]:
    """The arguments of the run that makes an agent, or goes on with it."""
    folder = work / name
    return [*AGENTS[name], "--out", str(folder), *(["--resume"] if holds_run(folder) else [])]


def _experiment(name: str, work: Path) -> Experiment:
    """What the flags of an agent's run give now."""
    ((experiment, _),) = experiments_of(parse_run(_command(name, work)))
    return experiment


def _is_current(name: str, work: Path) -> bool:
    """Whether the packaged agent has the settings that its flags give now, those added since as they are by default."""
    try:
        return experiment_of(read_agent(name).card.config, name, to_act=True) == _experiment(name, work)
    except (AgentFileError, UserError):  # there is none, or it is of another version
        return False


def _made(name: str, flags: PretrainFlags, console: PlainConsole) -> Path:
    """The file of an agent in its run folder, trained and evaluated as far as it is not yet."""
    folder = flags.work / name
    file = folder / f"{name}.safetensors"
    run.main(_command(name, flags.work))
    if not file.with_suffix(".json").exists():
        export(folder, file, step=None, num_tasks=flags.tasks, console=console)
    jax.clear_caches()  # compiled programs of one world are of no use in the next
    return file


if __name__ == "__main__":
    leave(call("pretrain", program="python -m experiments.pretrain"))
