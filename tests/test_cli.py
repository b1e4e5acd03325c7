import errno
import json
import os
import re
import subprocess
import sys
from dataclasses import is_dataclass
from importlib import import_module
from importlib.metadata import version
from inspect import signature
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.depth.small_training import write_tiny_weights
from tests.synthetic_street import make_street

from depthpose.cli import COMMANDS, main
from depthpose.cli.arguments import Source, WeightsName, make_parser, refuse_missing
from depthpose.cli.engine import EngineOptions
from depthpose.core.errors import InputError
from depthpose.core.files import read_depth_png, read_map, write_image, write_json
from depthpose.depth.types import DepthInput

NAMES = [name.split() for name in COMMANDS]


@pytest.fixture(scope="module")
def pair_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two pairs of the synthetic street, 497 x 150, with their rig."""
    folder = tmp_path_factory.mktemp("pairs")
    pair = make_street(0.4).input
    assert pair.right is not None
    for name in ("a", "b"):
        write_image(folder / "left" / f"{name}.png", pair.left)
        write_image(folder / "right" / f"{name}.png", pair.right)
    write_json(folder / "cam.json", _camera_file(pair))
    return folder


def _camera_file(pair: DepthInput) -> dict[str, object]:
    assert pair.camera is not None
    K = pair.camera.K.tolist()
    return {"width": pair.camera.width, "height": pair.camera.height, "K": K, "baseline_m": 0.54}


def match(folder: Path, out: Path, *more: str) -> int:
    return match_sides(folder / "left", folder / "right", folder / "cam.json", out, *more)


def match_sides(left: Path, right: Path, camera: Path, out: Path, *more: str) -> int:
    words = ["depth", "match", str(left), str(right), "--camera", str(camera), "--out", str(out)]
    return main([*words, *(more or ("--matcher", "sgbm"))])


@pytest.mark.parametrize("name", COMMANDS)
def test_help_reads_like_documentation(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*name.split(), "--help"]) == 0
    text = capsys.readouterr().out
    assert f"usage: depthpose {name}" in text
    assert len(text) > 300
    assert "Args:" not in text
    # No type and no default that is nothing: {None}|PATH, (default: ).
    words = " ".join(text.replace("│", " ").split())
    for code in ("{None", "None}", "|STR", "INT INT", "(default: )", "(default: None)"):
        assert code not in words, code


def test_help_loads_nothing_heavy() -> None:
    """Of all commands in one process: the first that loads something is named."""
    code = f"""
import sys
from depthpose.cli import main
for words in {[[], *NAMES]}:
    main([*words, "--help"])
    assert not {{"torch", "numpy", "PIL", "cv2"}} & set(sys.modules), words
"""
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_help_names_every_command_and_exit_code(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    for name in COMMANDS:
        shown = f"{name.split()[0]} ID" if name.split()[0] in ("reproduce", "figure") else name
        assert f"\n  {shown} " in text, name
    assert "130  interrupted" in text


def test_help_lists_the_stages_and_sets_the_thesis_apart(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["depth", "train", "--help"]) == 0
    text = capsys.readouterr().out
    for stage in ("view", "select", "stereo", "finetune"):
        assert f"\n      {stage} " in text, stage
    assert main(["--help"]) == 0
    first, _, of_thesis = capsys.readouterr().out.partition("tables and figures of the thesis:")
    assert "reproduce" not in first
    for name in COMMANDS:
        if name.startswith(("reproduce ", "figure ")):
            assert name.split()[1] in of_thesis, name


def test_help_has_no_line_breaks_of_the_code(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    assert main(["depth", "predict", "--help"]) == 0
    text = capsys.readouterr().out
    assert "height of the camera above the road in metres, which else is estimated" in text
    assert max(len(line) for line in text.splitlines()) <= 100
    between = text.partition("height of the camera")[2].partition("--camera-tilt NUMBER")[0]
    lines = [line.strip("│ ") for line in between.splitlines()[1:-1]]
    assert all(len(line) > 60 for line in lines[:-1]), lines  # filled, but for the last


@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_an_option_begins_with_a_noun_or_verb(name: str) -> None:
    module, _, function = COMMANDS[name][0].partition(":")
    command = getattr(import_module(f"depthpose.cli.{module}"), function)
    parse, _ = make_parser(command)
    hints = dict(parse.__annotations__)
    for parameter in signature(command).parameters.values():
        if is_dataclass(parameter.default):
            hints |= type(parameter.default).__annotations__
    marks = [mark for hint in hints.values() for mark in getattr(hint, "__metadata__", ())]
    texts = [mark.help for mark in marks if getattr(mark, "help", None)]
    assert len(texts) > 0
    for text in texts:
        assert text.split()[0] not in ("of", "at", "as"), text


def test_help_of_poses_begins_with_what_matters_and_ends_with_the_cluster(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["pose", "predict", "--help"]) == 0
    text = capsys.readouterr().out
    shown = re.findall(r"^[│ ] (?:-h, )?--([a-z][a-z-]*)", text, re.MULTILINE)
    assert shown[:9] == [
        "help", "out", "cad", "cad-unit", "depth", "camera", "mask", "box", "cloud",
    ]  # fmt: skip
    of_networks, of_ray = shown.index("weights"), shown.index("engine")
    assert of_networks > shown.index("min-certainty") > shown.index("bop")
    assert shown[of_ray:] == ["engine", "address", "workers", "worker-cpus", "worker-gpus", "block"]
    assert {"voting", "hypotheses", "batch", "device"} < set(shown[of_networks:of_ray])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["dept"], "no command 'dept'; did you mean 'depth'"),
        (["depth", "mach"], "no command 'mach'; did you mean 'match'"),
        (["weights", "show", "nope"], "neither a file nor the name of weights"),
        (["weights", "import", "psmnet", "none.tar", "--out", "w.safetensors",
          "--align-corners", "true"], "none.tar: there is no such file or folder"),
        (["weights", "import", "psmnet", ".", "--out", "w.safetensors"],
         "needs --align-corners"),
        (["weights", "import", "resnet18", ".", "--out", "w.safetensors",
          "--align-corners", "true"], "--align-corners true: is for psmnet"),
        (["weights", "import", "resnet18", "none.pth", "--out", "w.safetensors"],
         "none.pth: there is no such file or folder"),
        (["data", "check", "nowhere"], "nowhere"),
        (["depth", "evaluate", "--data", ".", "--out", "o"], "measure --weights FILE"),
        (
            ["depth", "match", ".", ".", "--camera", ".", "--out", "o", "--matcher", "sgbm",
             "--weights", "default"],
            "--weights: has no effect here; --matcher matches the pair",
        ),
        (["depth", "match", "l", "r", "--camera", "c.json", "--out", "o", "--matcher", "sgbm"],
         "l: there is no such file or folder"),
        (["export", "depth", "--weights", "parts", "--out", "d.onnx"],
         "kind 'geoposenet'; depth takes"),
        (["export", "pose", "--weights", "default", "--out", "p.onnx"],
         "kind 'fakestereo', but a pose takes"),
        (["export", "depth", "--weights", "nowhere", "--out", "d.onnx"],
         "neither a file nor the name"),
        (["export", "depth", "--out", "d.engine"], "end the name in .onnx"),
        (["depth", "predict", "--focal-px", "700", "--out", "o"], "name images, folders of them"),
        (["depth", "evaluate", "--data", ".", "--weights", "default", "--cap", "-1", "--out", "o"],
         "--cap -1: a distance in metres, above 0"),
        (["depth", "evaluate", "--data", ".", "--matcher", "sgbm", "--device", "cuda",
          "--out", "o"],
         "--device: has no effect here; no network is measured"),
        (["depth", "evaluate", "--data", ".", "--weights", "sgbm:default", "--precision",
          "bf16", "--out", "o"], "no matcher with weights runs"),
        (["weights", "list", "--folder", "nowhere"], "nowhere: there is no such file or folder"),
        (["data", "check", "x" * 300], "File name too long"),
    ],
)  # fmt: skip
def test_wrong_words_are_refused(
    words: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_command_leaves_the_next_one_as_quick(capsys: pytest.CaptureFixture[str]) -> None:
    """Of many in one process: what is said of an option is not said once more each time."""
    described: list[str] = []
    for _ in range(2):
        assert main(["depth", "match", "--help"]) == 0
        described.append(str(EngineOptions.__annotations__))
    assert described[1] == described[0]


def test_an_unknown_option_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--outt", "x"]) == 2
    assert "--outt" in capsys.readouterr().err


def test_the_version_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    said = capsys.readouterr().out
    assert said.startswith("depthpose 0.")
    device = torch.cuda.get_device_name() if torch.cuda.is_available() else "cpu alone"
    # The installed version, which does not name the build for GPUs that PyPI has.
    assert f"(torch {version('torch')}, Python 3." in said
    assert said.endswith(f"{device})\n")


def test_output_that_nobody_reads_is_no_mistake() -> None:
    """As in ``depthpose weights show parts | head -1``."""
    command = [sys.executable, "-m", "depthpose", "weights", "show", "parts"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as running:
        assert running.stdout is not None
        assert running.stderr is not None
        running.stdout.close()
        assert running.stderr.read() == b""
    assert running.returncode == 141


def test_matching_writes_every_file(pair_folder: Path, tmp_path: Path) -> None:
    assert match(pair_folder, tmp_path / "o", "--matcher", "sgbm", "--cloud") == 0
    kinds = ("depth_m.npy", "disparity_px.npy", "depth.png", "color.png", "cloud.ply")
    assert all((tmp_path / "o" / f"{name}.{kind}").is_file() for name in "ab" for kind in kinds)
    depth_m = read_map(tmp_path / "o/a.depth_m.npy")
    png_m = read_depth_png(tmp_path / "o/a.depth.png")
    both = torch.isfinite(depth_m) & torch.isfinite(png_m)
    assert (depth_m - png_m)[both].abs().max() <= 0.5 / 256
    assert np.load(tmp_path / "o/a.depth_m.npy").dtype == np.float32


def test_a_rerun_keeps_what_is_finished_and_refuses_other_settings(
    pair_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert match(pair_folder, tmp_path) == 0
    written = (tmp_path / "a.disparity_px.npy").stat().st_mtime_ns
    (tmp_path / "b.disparity_px.npy").unlink()
    assert match(pair_folder, tmp_path) == 0
    assert (tmp_path / "a.disparity_px.npy").stat().st_mtime_ns == written
    assert (tmp_path / "b.disparity_px.npy").is_file()
    record = json.loads((tmp_path / "run.json").read_text())
    record["settings"]["camera"]["baseline_m"] = 0.1
    (tmp_path / "run.json").write_text(json.dumps(record))
    assert match(pair_folder, tmp_path) == 2
    assert "Two settings never share a folder" in capsys.readouterr().err


def test_one_broken_pair_does_not_stop_the_others(
    pair_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for side in ("left", "right"):
        (tmp_path / "in" / side).mkdir(parents=True)
        for name in ("a", "b"):
            content = (pair_folder / side / f"{name}.png").read_bytes()
            (tmp_path / "in" / side / f"{name}.png").write_bytes(content)
    (tmp_path / "in/cam.json").write_bytes((pair_folder / "cam.json").read_bytes())
    broken = tmp_path / "in/left/b.png"
    broken.write_bytes(broken.read_bytes()[:5000])
    assert match(tmp_path / "in", tmp_path / "out") == 1
    assert "b.png" in capsys.readouterr().err
    assert (tmp_path / "out/a.depth_m.npy").is_file()
    assert not (tmp_path / "out/b.disparity_px.npy").exists()


def test_without_bf16_one_line_is_said_and_the_record_says_fp32(
    pair_folder: Path, tmp_path: Path
) -> None:
    code = (
        "import sys; from depthpose.core import devices; from depthpose.cli import main; "
        "devices.computes_bf16 = lambda _: False; sys.exit(main(sys.argv[1:]))"
    )
    one = [str(pair_folder / side / "a.png") for side in ("left", "right")]
    words = ["depth", "match", *one, "--camera", str(pair_folder / "cam.json"), "--out"]
    write_tiny_weights(tmp_path)
    weights = str(tmp_path / "m.safetensors")
    words += [str(tmp_path / "o"), "--weights", weights, "--precision", "bf16"]
    command = [sys.executable, "-c", code, *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr.splitlines() == [
        "depthpose: this processor has no arithmetic for bf16 (AVX-512, AMX); fp32 is taken in its "
        "place"
    ]
    assert json.loads((tmp_path / "o" / "run.json").read_text())["settings"]["precision"] == "fp32"


def test_options_of_psmnet_are_refused_with_sgbm(
    pair_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert match(pair_folder, tmp_path / "o", "--matcher", "sgbm", "--left-right-check") == 2
    assert "has no effect here; sgbm has no weights" in capsys.readouterr().err
    assert match(pair_folder, tmp_path / "o", "--matcher", "sgbm", "--max-disparity", "99") == 2
    assert "--max-disparity" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


def test_swapped_sides_are_refused(
    pair_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    right, left = pair_folder / "right", pair_folder / "left"
    assert match_sides(right, left, pair_folder / "cam.json", tmp_path) == 1
    said = capsys.readouterr().err
    assert all(f"failed: {name}: left and right look swapped" in said for name in "ab")


@pytest.mark.parametrize(
    ("change", "message", "code"),
    [
        ({"baseline_m": None}, "baseline", 2),
        ({"width": 1242}, "1242", 1),
        ({"baseline_m": 540.0}, "540", 2),
        ({"baselin": 1}, "did you mean 'baseline_m'", 2),
    ],
)
def test_a_wrong_camera_is_refused(
    pair_folder: Path,
    tmp_path: Path,
    change: dict[str, object],
    message: str,
    code: int,
    capsys: pytest.CaptureFixture[str],
) -> None:
    camera = json.loads((pair_folder / "cam.json").read_text()) | change
    camera = {name: value for name, value in camera.items() if value is not None}
    write_json(tmp_path / "cam.json", camera)
    left, right = pair_folder / "left", pair_folder / "right"
    assert match_sides(left, right, tmp_path / "cam.json", tmp_path / "o") == code
    assert message in capsys.readouterr().err


def test_a_side_with_more_images_is_refused(
    pair_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    left, right = pair_folder / "left", pair_folder / "right/a.png"
    assert match_sides(left, right, pair_folder / "cam.json", tmp_path) == 2
    assert "no partner of the same name or number is there for 'b'" in capsys.readouterr().err


@pytest.mark.parametrize("size", ["1 parsec", "-1GB", "GB", "", "0", "0.0GB"])
def test_a_size_that_is_none_is_refused(
    size: str, pair_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "w.safetensors").touch()
    more = (f"--max-memory={size}", "--weights", str(tmp_path / "w.safetensors"))
    assert match(pair_folder, tmp_path / "o", *more) == 2
    assert "not a size" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["depth", "predict", "lfet.png", "--focal-px", "9"], "did you mean 'left.png'?"),
        (["depth", "match", "left.png", "right.png", "--camera", "c.json"], "right.png: there is"),
        (["depth", "train", "view", "--data", "left.png", "streets"], "streets: there is no such"),
        (["pose", "train", "--cad", "part.stl", "--unit", "mm"], "part.stl: there is no such"),
        (["pose", "predict", "--cloud", "a.ply"], "a.ply: there is no such file"),
    ],
)
def test_a_path_that_leads_nowhere_is_refused_before_torch_is_loaded(
    words: list[str], said: str, tmp_path: Path
) -> None:
    (tmp_path / "left.png").touch()
    code = (
        "import sys; from depthpose.cli import main; code = main(sys.argv[1:]); "
        "assert not {'torch', 'numpy', 'PIL'} & set(sys.modules); sys.exit(code)"
    )
    command = [sys.executable, "-c", code, *words, "--out", "out"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stderr
    assert said in done.stderr


@pytest.mark.skipif(sys.platform == "win32", reason="there is no limit of address space")
@pytest.mark.parametrize("kib", [100_000, 450_000, 740_000])
@pytest.mark.parametrize("images", [("match", "l.png", "r.png"), ("predict", "l.png")])
def test_a_limit_below_what_the_libraries_take_is_refused_before_they_end_the_process(
    images: tuple[str, ...], kib: int, tmp_path: Path
) -> None:
    """At 450,000 glibc aborts, at 500,000 OpenBLAS ends the process: neither names a remedy.

    The look at weights that a command names by default loaded the libraries before the check.
    """
    limit = f"resource.setrlimit(resource.RLIMIT_AS, ({kib * 1024},) * 2)"
    code = f"import resource, sys; from depthpose.cli import main; {limit}; sys.exit(main())"
    words = ["depth", *images, "--camera", "c.json", "--out", "out"]
    for name in images[1:]:
        write_image(tmp_path / name, torch.zeros(3, 8, 8))
    (tmp_path / "c.json").write_text("{}")
    command = [sys.executable, "-c", code, *words]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr == (
        f"depthpose: error: the limit of {kib} KiB (ulimit -v) is below the 750000 that the "
        "libraries alone take; raise it\n"
    )


@pytest.mark.parametrize(
    ("words", "option"),
    [
        ("pose predict --cloud . --out", "--out"),
        ("depth predict . --focal-px 9 --out=", "--out"),
        ("pose predict --out out --cloud", "--cloud"),
        ("depth train select --out out --held-out", "--held-out"),
    ],
)
def test_an_option_without_a_path_is_not_the_current_folder(
    words: str, option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    given = words.split() if words.endswith("=") else [*words.split(), ""]
    assert main(given) == 2
    assert f"{option} is empty; name a file or folder" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["depth", "evaluate", "--data", ".", "--weights", "both:nope"], "weights 'nope': neither"),
        (["pose", "predict", "--cloud", ".", "--weights", "prats"], "did you mean 'parts'?"),
    ],
)
def test_weights_of_no_such_name_are_refused(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*words, "--out", str(tmp_path / "out")]) == 2
    assert said in capsys.readouterr().err


def test_patterns_and_addresses_are_left_to_those_who_read_them() -> None:
    def command(images: tuple[Source, ...], bop: Path | None, start: WeightsName) -> int:
        return len(images)

    _, options = make_parser(command)
    values = {"images": ("left/*.png", "s3://bucket/left"), "bop": None, "start": "hf://me/mine"}
    refuse_missing(options, values)
    for word in ("sgbm:default", "register", "nothing"):
        refuse_missing(options, {"start": word})
    with pytest.raises(InputError, match="there is no such file or folder"):
        refuse_missing(options, {"bop": Path("nowhere")})
    with pytest.raises(InputError, match="default"):
        refuse_missing(options, {"start": "defalt"})


@pytest.mark.parametrize(
    ("place", "said"), [("/x/events", "/x/events: "), (None, "a temporary file in ")]
)
def test_a_full_disk_under_a_library_is_one_line(
    place: str | None, said: str, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    def refuse(**_: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), place)

    monkeypatch.setattr("depthpose.cli.weights.list_weights", refuse)
    assert main(["weights", "list"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"depthpose: error: {said}")
    assert "cannot be written: No space left on device; free the space" in line
