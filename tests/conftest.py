"""Fixtures shared by all tests."""

import os
from pathlib import Path

import pytest

# Some virtual machines say that they have AMX and stop whoever uses it (oneDNN does, for bfloat16): illegal instruction.
os.environ.setdefault("ONEDNN_MAX_CPU_ISA", "AVX512_CORE_FP16")

WITH_SMOKE = {f"tests/test_{name}.py" for name in ("evaluate_job", "generation_jobs", "publish", "voxel_import")}
LONG = ("evaluate_job", "generation_jobs", "voxel_import", "faults", "jobs", "commands", "ablation", "ingest", "street")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Modules that take minutes go first, so that none of them is left for one process at the end."""
    order = {f"test_{name}": place for place, name in enumerate(LONG)}
    items.sort(key=lambda item: order.get(item.path.stem, len(LONG)))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log):
    """Under `-n 2` a module stays in one process, and so do all modules that use `smoke`; in the order of collection."""
    config.option.loadscopereorder = False
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            module = super()._split_scope(nodeid)
            return "smoke" if module in WITH_SMOKE else module

    return Scheduling(config, log)


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Real excerpts (kitti360/, av2/): $PRITTI_TEST_DATA, or if unset shared/data beside the checkout."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    path = Path(os.environ.get("PRITTI_TEST_DATA") or beside)
    if not path.is_dir():
        pytest.skip(f"no real data: {path} does not exist; set PRITTI_TEST_DATA to a folder with kitti360/ and av2/")
    return path


@pytest.fixture(scope="session")
def cluster(tmp_path_factory):
    """One small local Ray for all tests that need it, and a $PRITTI_HOME that is nobody's."""
    from jobs.support.cli import RAY_ENVIRONMENT

    settings = {
        "PRITTI_HOME": str(tmp_path_factory.mktemp("nobody")),
        "RAY_AUTH_MODE": "disabled",
        "RAY_DATA_USE_DATASOURCE_V2": "0",
        "RAY_TRAIN_HEALTH_CHECK_INTERVAL_S": "0.2",
        "RAY_worker_niceness": "0",  # workers must not starve beside the tests of another process
        "DO_NOT_TRACK": "true",
    }
    os.environ.update(RAY_ENVIRONMENT | settings)
    os.environ.pop("MLFLOW_TRACKING_URI", None)
    import logging

    import ray
    import ray.data

    logging.getLogger("ray").setLevel(logging.WARNING)
    logging.getLogger("ray.data").setLevel(logging.WARNING)
    ray.init(
        address="local",
        num_cpus=2,
        object_store_memory=300 * 2**20,
        logging_level="WARNING",
        log_to_driver=False,
        include_dashboard=False,
    )
    yield
    ray.shutdown()


@pytest.fixture(scope="session")
def home(tmp_path_factory, cluster) -> Path:
    """A $PRITTI_HOME of its own, in which the smoke presets have run once: data, models, latents."""
    path = tmp_path_factory.mktemp("home")
    os.environ["PRITTI_HOME"] = str(path)
    from jobs.implementation.train_dit import train
    from jobs.train_dit import Config

    train(Config(preset="smoke"))
    return path


@pytest.fixture(scope="session")
def smoke(tmp_path_factory, cluster) -> Path:
    """A $PRITTI_HOME for what comes after training: as `home`, but trained in this process, without Ray Train."""
    path = tmp_path_factory.mktemp("smoke")
    os.environ["PRITTI_HOME"] = str(path)
    import torch

    import jobs.support.trainer
    from jobs.implementation.train_dit import train
    from jobs.support.trainer import as_tensors
    from jobs.train_dit import Config
    from pipelines.training.data_loader import batches

    def fit_here(run, num_workers: int, output: str) -> str:
        trainer = run.build(torch.device("cpu"), lambda model: model)
        for batch in batches(run.stream, run.reader, 0, run.settings.steps):
            trainer.step(as_tensors(batch), range(run.stream.batch_size))
        model = trainer.averaged()
        jobs.support.trainer.tag_weights(run.tracker, model, trainer.steps_done)
        model.save_pretrained(output)
        run.tracker.finish("FINISHED")
        return output

    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(jobs.support.trainer, "fit", fit_here)
        train(Config(preset="smoke"))
    return path
