"""The cluster examples: what a cluster would reject, and what docs/cluster.md says of them."""

import shutil
import subprocess
from pathlib import Path

import pytest
import typer
import yaml

EXAMPLES = Path(__file__).parents[2] / "examples" / "cluster"


def study_options():
    """Options of ``dudmap study run``."""
    from dudmap.cli.study import app

    command = typer.main.get_command(app).commands["run"]
    return {name for parameter in command.params for name in parameter.opts if name.startswith("--")}


def containers(spec):
    return spec["template"]["spec"]["containers"]


def test_the_ray_job_has_the_fields_of_kuberay():
    job = yaml.safe_load((EXAMPLES / "rayjob.yaml").read_text(encoding="utf-8"))
    assert (job["apiVersion"], job["kind"]) == ("ray.io/v1", "RayJob")
    cluster = job["spec"]["rayClusterSpec"]
    head, workers = cluster["headGroupSpec"], cluster["workerGroupSpecs"]
    assert head["rayStartParams"]["num-cpus"] == "0"
    assert all(isinstance(value, str) for value in head["rayStartParams"].values())  # KubeRay takes text only
    for group in workers:
        assert group["minReplicas"] <= group["replicas"] <= group["maxReplicas"]
    for spec in (head, *workers):
        volumes = {volume["name"] for volume in spec["template"]["spec"]["volumes"]}
        for container in containers(spec):
            assert {mount["name"] for mount in container["volumeMounts"]} == volumes
            assert container["resources"]["limits"] == container["resources"]["requests"]
    # equal images on all nodes: Ray refuses a cluster of different versions
    assert len({container["image"] for spec in (head, *workers) for container in containers(spec)}) == 1


def test_the_examples_call_commands_and_options_that_exist():
    job = yaml.safe_load((EXAMPLES / "rayjob.yaml").read_text(encoding="utf-8"))
    script = (EXAMPLES / "slurm.sh").read_text(encoding="utf-8")
    lines = script.replace("\\\n", " ").splitlines()
    calls = [
        job["spec"]["entrypoint"],
        next(line for line in lines if "dudmap study" in line and "RAY_ADDRESS" in line),
    ]
    for call in calls:
        words = call.partition("dudmap study")[2].split()
        assert {word for word in words if word.startswith("--")} <= study_options()
        assert "--cluster" in words
    folder = job["spec"]["entrypoint"].partition("--out ")[2].split()[0]
    mounted = {
        mount["mountPath"] for mount in containers(job["spec"]["rayClusterSpec"]["headGroupSpec"])[0]["volumeMounts"]
    }
    assert any(folder.startswith(f"{path}/") for path in mounted)


def test_the_slurm_script_is_valid_bash_and_asks_for_what_it_uses():
    script = EXAMPLES / "slurm.sh"
    text = script.read_text(encoding="utf-8")
    assert text.startswith("#!/bin/bash\n")
    asked = [line for line in text.splitlines() if line.startswith("#SBATCH")]
    assert {"--ntasks-per-node", "--cpus-per-task", "--time"} <= {line.split()[1].partition("=")[0] for line in asked}
    if shutil.which("bash") is None:
        pytest.skip("there is no bash")
    subprocess.run(["bash", "-n", str(script)], check=True)
