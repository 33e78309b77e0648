"""Rows of engines as text."""

from typing import Any

from mtl_bench.engines.noise import DRIFT, SPREAD


def lines(row: dict[str, Any]) -> list[str]:
    """What a row says, for a terminal."""
    what = f"{row['backbone']} {','.join(row['tasks'])} {row['height']}x{row['width']}"
    head = f"{what} {row['engine']} {row['precision']}, {row['weights']} weights"
    if row["status"] != "done":
        return [head, f"  {row['status']}: {row['why']}"]
    m = {key.partition(".")[2]: value for key, value in row["metric"].items()}
    noise = f"  spread {m['spread']:.2f}, drift {m['drift']:+.2f}"
    noise += f": noisy (limits {SPREAD}, {DRIFT}), take it again" if m["noisy"] else ""
    return [
        head,
        f"  {m['mean_ms']:.1f} ms (p50 {m['p50_ms']:.1f}, p95 {m['p95_ms']:.1f}, p99 "
        f"{m['p99_ms']:.1f}, std {m['std_ms']:.1f})  FPS {m['fps']:.2f}",
        f"  transfer {m['transfer_ms']:.1f}, network {m['network_ms']:.1f}, post-processing "
        f"{m['postprocess_ms']:.1f} ms",
        f"  {m['passes']} passes after {m['warmup']}, {m['images']} images, {m['threads']} "
        f"threads, {m['device']}",
        noise,
        f"  throughput {m['throughput_fps']:.2f} images a second at batch {m['throughput_batch']}",
        f"  {m['gmacs']:.1f} G multiply-adds, {m['network_mb']:.0f} MB; machine "
        f"{m['peak_gflops']:.0f} GFLOP/s, {m['peak_gbs']:.1f} GB/s: share {m['share']:.2f}",
        f"  against plain: {_agreement(row)}",
    ]


def _agreement(row: dict[str, Any]) -> str:
    found = row["metric"]
    words = []
    if "agreement.panoptic_equal" in found:
        words.append(f"{100 * found['agreement.panoptic_equal']:.3f} % panoptic pixels")
        words.append(f"logits {found['agreement.logits_max']:.1g}")
    if "agreement.depth_median_rel" in found:
        median, most = found["agreement.depth_median_rel"], found["agreement.depth_max_rel"]
        words.append(f"depth {median:.1g} (largest {most:.1g})")
    return ", ".join(words)


def table(rows: list[dict[str, Any]]) -> list[list[str]]:
    """Words of several rows, line by line, the head first; `faster` is than plain's."""
    head = ["engine", "precision", "ms", "p95", "FPS", "transfer", "network", "post", "faster"]
    rows_of_words = [[*head, "against plain"]]
    done = {(row["engine"], row["precision"]): row["metric"] for row in rows}
    plain = done.get(("plain", "fp32"), {}).get("latency.mean_ms")
    for row in rows:
        m = row["metric"]
        if row["status"] != "done":
            about = f"{row['status']}: {row['why']}"
            rows_of_words.append([row["engine"], row["precision"], *[""] * 7, about])
            continue
        times = [f"{m[f'latency.{key}_ms']:.1f}" for key in ("mean", "p95")]
        stages = [f"{m[f'latency.{key}_ms']:.1f}" for key in ("transfer", "network", "postprocess")]
        faster = "" if plain is None else f"{plain / m['latency.mean_ms']:.2f}x"
        noisy = ", noisy" if m["latency.noisy"] else ""
        values = [*times, f"{m['latency.fps']:.2f}", *stages, faster, _agreement(row) + noisy]
        rows_of_words.append([row["engine"], row["precision"], *values])
    return rows_of_words
