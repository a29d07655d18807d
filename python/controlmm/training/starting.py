"""Training from given weights: a model that ships is trained further, and lends the stages that lack."""

from __future__ import annotations

import shutil
from pathlib import Path

import torch

from controlmm.nn.checkpoint import CONFIG_FILE, WEIGHTS_FILE, PretrainedModel, read_weights
from controlmm.pipelines.folder import PIPELINE_FILE, TEXT_ENCODER_FILE, read_json, read_pipeline
from controlmm.text import check_same_encoder
from controlmm.training.registry import load_stage
from controlmm.training.run_folder import SETTINGS_FILE
from controlmm.training.stage import NORMALIZER_FILE, Stage


def starting_folder(path: Path, stage: Stage) -> Path:
    """Where the weights that ``stage`` starts from are.

    Args:
        path: A network's folder (``config.json``, ``model.safetensors``), or a model folder that holds it.
        stage: The stage to train.

    Raises:
        FileNotFoundError: If there are no such weights.
        ValueError: If the stage cannot start from weights alone, or the whole model is of another system.
    """
    if stage.network is None or not stage.starts_from_weights:
        raise ValueError(
            f"Stage {stage.name!r} cannot start from given weights: its training needs more than a model "
            "folder keeps. Train it from the beginning."
        )
    if (path / PIPELINE_FILE).is_file():
        read_pipeline(path, stage.system)
    for folder in (path, path / stage.network):
        if (folder / CONFIG_FILE).is_file() and (folder / WEIGHTS_FILE).is_file():
            return folder
    raise FileNotFoundError(
        f"No weights to start {stage.name!r} from in {path}: expected {CONFIG_FILE} and {WEIGHTS_FILE} there "
        f"or in {path / stage.network}."
    )


def adopt_earlier_stages(model: Path, root: Path, stage: Stage) -> None:
    """Copy what ``stage`` needs from the folder of a whole model, unless ``root`` has it already.

    Each copy appears as a whole or not at all. A folder that is no whole model lends nothing.

    Raises:
        ValueError: If ``root`` uses another text encoder than the model.
    """
    if not (model / PIPELINE_FILE).is_file():
        return
    root.mkdir(parents=True, exist_ok=True)
    if (root / TEXT_ENCODER_FILE).is_file():
        check_same_encoder(read_json(model / TEXT_ENCODER_FILE), read_json(root / TEXT_ENCODER_FILE))
    for name in (TEXT_ENCODER_FILE, NORMALIZER_FILE):
        if not (root / name).is_file():
            _copy_whole(model / name, root / name)
    for need in stage.needs:
        network = load_stage(need).network
        if network is not None and not (root / need / "best").is_dir():
            (root / need).mkdir(exist_ok=True)
            _copy_whole(model / network, root / need / "best")
            if (model / network / SETTINGS_FILE).is_file():
                _copy_whole(model / network / SETTINGS_FILE, root / need / SETTINGS_FILE)


def load_starting_weights(network: PretrainedModel, folder: Path) -> None:
    """Put the weights in ``folder`` into a network that was built from their configuration.

    Raises:
        ValueError: If they do not fit, as when the data's skeleton or the text encoder is another.
    """
    fresh = network.state_dict()
    kept = {name: fresh[name] for name in fresh if name.rpartition(".")[2] in network.training_state}
    try:
        with torch.no_grad():
            network.load_state_dict(kept | read_weights(folder / WEIGHTS_FILE))
    except RuntimeError as error:
        reason = " ".join(str(error).split())
        raise ValueError(
            f"The weights in {folder} do not fit this data and text encoder: {reason}"
        ) from error


def _copy_whole(source: Path, target: Path) -> None:
    partial = target.with_name(target.name + ".tmp")
    if source.is_dir():
        shutil.rmtree(partial, ignore_errors=True)
        shutil.copytree(source, partial)
    else:
        shutil.copyfile(source, partial)
    partial.replace(target)
