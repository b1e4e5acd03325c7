"""``depthpose serve``."""

from depthpose.cli.arguments import WeightsName, refuse_below
from depthpose.core.errors import MissingExtraError


def serve(
    host: str = "127.0.0.1",
    port: int = 8000,
    weights: WeightsName = "default",
    pose_weights: WeightsName = "parts",
    max_upload_mb: int = 64,
    max_seconds: int = 120,
) -> int:
    """Serve a page for your browser: drop an image, a pair, a depth image or a cloud onto it.

    Tab Depth: depth, the synthesised right view, confidence and a cloud. Tab Pose: votes, the posed
    model and its covariance, or the reason for a refusal. All results can be downloaded. It needs
    no network, sends nothing anywhere, leaves nothing on the disk, and by default answers this
    machine alone. Needs the extra 'serve'. Ctrl+C stops it.

        depthpose serve
        depthpose serve --pose-weights my_part/pose.safetensors --port 8080

    Args:
        host: 127.0.0.1 is this machine alone; with 0.0.0.0 everyone who can reach this machine can
            use the page: there is no password and no encryption.
        port: port of the page; 0 takes a free one.
        weights: weights of the depth networks, by name or file ('depthpose weights list').
        pose_weights: weights of a pose network, by name or file.
        max_upload_mb: all files of one request together [1e6 bytes].
        max_seconds: time of one computation; a longer one is stopped, as others wait for it.
    """
    try:
        from depthpose.web import Limits, find_address_and_hosts, make_app, open_socket, run
    except ModuleNotFoundError as error:
        package = (error.name or "starlette").partition(".")[0]
        raise MissingExtraError(package, "serve", "the page in the browser") from error
    from depthpose.depth.estimator import FakestereoNet
    from depthpose.pose.network_pose import GeoPoseNet

    refuse_below(1, "--max-upload-mb", max_upload_mb, "64")
    refuse_below(1, "--max-seconds", max_seconds, "120")
    listener = open_socket(host, port)  # a port in use is refused before weights are loaded
    address, hosts = find_address_and_hosts(host, listener)
    limits = Limits(upload_bytes=max_upload_mb * 10**6, compute_s=max_seconds, hosts=hosts)
    depth = FakestereoNet.load(weights, allow_ood=True)
    app = make_app(depth, GeoPoseNet.load(pose_weights), limits)
    shown = f"[{address}]" if address.version == 6 else address
    print(f"http://{shown}:{listener.getsockname()[1]}/  (Ctrl+C stops it)", flush=True)
    if not address.is_loopback:
        print("whoever can reach this address may use the page: no password, no encryption",
              flush=True)  # fmt: skip
    try:
        run(app, listener)
    except KeyboardInterrupt:
        print("stopped")
    return 0
