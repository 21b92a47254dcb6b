"""A launcher of Hydra that runs the jobs of a sweep on a Ray cluster, `-m hydra/launcher=ray`.

Hydra finds launchers in the namespace `hydra_plugins` alone, and imports this file at every start. So it imports Ray
and the package where they are needed.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.core.singleton import Singleton
from hydra.core.utils import JobReturn, JobStatus, configure_log, run_job, setup_globals
from hydra.errors import CompactHydraException
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, open_dict

SETTINGS = {
    "_target_": "hydra_plugins.pirl_rl_ray.RayLauncher",
    "address": None,
    "cpus_per_run": 1.0,
    "gpus_per_run": 0.0,
}
"""The keys of `hydra.launcher`, with their defaults."""


class RayLauncher(Launcher):
    """Runs each job as a task of Ray, as many at a time as the cluster has processors for.

    A task whose process or machine dies is run again by Ray, up to three times, and `pirl_rl.commands.train` then goes
    on from the last checkpoint. All machines need the working directory under the same path.

    Args:
        address: the address of a running cluster, "auto" for that to which this machine belongs, or None for a Ray of
            its own on this machine.
        cpus_per_run, gpus_per_run: what a job takes of the cluster.
    """

    def __init__(self, address: str | None, cpus_per_run: float, gpus_per_run: float):
        self.address, self.resources = address, {"num_cpus": cpus_per_run, "num_gpus": gpus_per_run}

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        self.hydra_context, self.task_function, self.config = hydra_context, task_function, config

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Run all jobs; returns what they returned, in their order."""
        from pirl_rl.cluster import connected, require_ray
        from pirl_rl.commands.console import reported

        setup_globals()
        configure_log(self.config.hydra.hydra_logging, self.config.hydra.verbose)
        folder = Path(self.config.hydra.sweep.dir)
        folder.mkdir(parents=True, exist_ok=True)
        with reported(folder):
            require_ray("hydra/launcher=ray")
        with reported(folder), connected(self.address, show_output=True) as ray:
            job = ray.remote(**self.resources)(run_here)
            shared = [self.hydra_context, self.task_function, self.config, Singleton.get_state(), os.getcwd()]
            print(
                f"{len(job_overrides)} runs on a Ray cluster with {ray.cluster_resources().get('CPU', 0):g} processors"
            )
            tasks = [
                job.options(name=f"run {number}").remote(number, list(overrides), *shared)
                for number, overrides in enumerate(job_overrides, initial_job_idx)
            ]
            return [_result(ray, *pair) for pair in zip(tasks, job_overrides, strict=True)]


def run_here(
    number: int,
    overrides: list[str],
    hydra_context: HydraContext,
    task_function: TaskFunction,
    config: DictConfig,
    singletons: dict[Any, Any],
    folder: str,
) -> JobReturn:
    """Run a job of a sweep in this process of the cluster.

    Args:
        number: the number of the job in the sweep.
        overrides: its overrides.
        hydra_context, task_function, config: what Hydra gave the launcher.
        singletons: the state of Hydra in the process of the launcher.
        folder: the working directory of that process.
    """
    from pirl_rl.commands.console import quiet_libraries

    os.chdir(folder)
    quiet_libraries()
    setup_globals()
    Singleton.set_state(singletons)
    job = hydra_context.config_loader.load_sweep_config(config, overrides)
    with open_dict(job):
        job.hydra.job.num, job.hydra.job.id = number, f"{job.hydra.job.name}_{number}"
    HydraConfig.instance().set_config(job)
    return run_job(task_function, job, "hydra.sweep.dir", "hydra.sweep.subdir", hydra_context)


def _result(ray: Any, task: Any, overrides: Sequence[str]) -> JobReturn:
    """What a job returned, or the reason why it returned nothing."""
    from pirl_rl.cluster import reason_of

    try:
        return ray.get(task)
    except ray.exceptions.RayError as error:
        failed = JobReturn(overrides=overrides, status=JobStatus.FAILED)
        failed.return_value = CompactHydraException(f"error: the run with {' '.join(overrides)}: {reason_of(error)}")
        return failed


ConfigStore.instance().store(group="hydra/launcher", name="ray", node=SETTINGS, provider="pirl_rl")
