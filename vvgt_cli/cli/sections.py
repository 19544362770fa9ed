"""Sections of `--help`: the options most people need first, the others by subject."""

from __future__ import annotations

import click

SECTIONS = {  # parameters by name, in the order shown; all others come first, under "Options"
    "Input": "dims dtype byte_order header_bytes spacing space array component time crop mask",
    "Look": "tf_range opacity_unit_distance labels layers ambient diffuse specular specular_power occlusion",
    "Quality": "steps init model rule seed renderer samples step",
    "Output": "frame up sh_degree comments split_labels format half background points report conditions",
    "Running": "device checkpoint shard block_size workers scheduler level threads memory quiet",
}


class SectionedCommand(click.Command):
    """A command whose ``--help`` lists its options under the headings of `SECTIONS`."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options under their headings."""
        options = [param for param in self.get_params(ctx) if isinstance(param, click.Option)]
        rows = {option.name: row for option in options if (row := option.get_help_record(ctx))}
        sections = {
            title: [rows.pop(name) for name in names.split() if name in rows] for title, names in SECTIONS.items()
        }
        for title, listed in {"Options": list(rows.values()), **sections}.items():
            if listed:
                with formatter.section(title):
                    formatter.write_dl(listed)
