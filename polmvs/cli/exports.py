"""The command that exports a finished run for other programs."""

from __future__ import annotations

from polmvs.cli.call import Call
from polmvs.cli.commands import ExportArguments
from polmvs.cli.terminal import Terminal
from polmvs.config import CropOptions
from polmvs.pipeline.export import ExportRequest, export_format, export_run
from polmvs.pipeline.run_folder import RunFolder


def export(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs export``."""
    given = call.get(ExportArguments)
    form = export_format(given.target, given.format)
    written = export_run(
        RunFolder(given.run),
        ExportRequest(
            target=given.target,
            form=form,
            model=given.model,
            texture=given.texture,
            texture_px=given.texture_px,
            colors=given.colors,
            part=given.part,
            crop=call.get(CropOptions),
            overwrite=given.overwrite,
        ),
    )
    what = [
        f"{number:,} {noun}"
        for number, noun in (
            (written.num_triangles, "triangles"),
            (0 if written.num_triangles else written.num_points, "points"),
            (written.num_views, "posed images"),
        )
        if number
    ]
    if written.texture_px:
        what.append(f"a texture of {written.texture_px} px")
    names = ", ".join(map(str, written.files))
    what.append("in metres" if written.is_metric else "in the model's own unit, of no known scale")
    terminal.show(f"{names}: {', '.join(what)}", {"format": form, **vars(written)})
    return 0
