"""Sections of `--help`: the options most people need first, the others by subject."""

from __future__ import annotations

import os

import click

SECTIONS = {  # parameters by name, in the order shown; all others come first, under "Options"
    "Input": "dims dtype byte_order header_bytes spacing space array component time crop mask keep_largest",
    "Look": "iso tf_range opacity_unit_distance labels layers ambient diffuse specular specular_power occlusion",
    "Quality": "steps init model rule seed renderer samples step",
    "Output": "frame up camera sh_degree comments split_labels slices format half background points report conditions",
    "Running": "dry_run device checkpoint shard block_size workers scheduler level threads memory quiet",
}


class SectionedCommand(click.Command):
    """A command whose ``--help`` lists its options under the headings of `SECTIONS`."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments; where there are more files than expected, say how a series is given.

        Raises:
            click.UsageError: invalid arguments.
        """
        given = list(args)
        try:
            return super().parse_args(ctx, args)
        except click.UsageError as error:
            files = [word for word in given if os.path.exists(word)]
            if "unexpected extra argument" not in error.message or len(files) < 2:
                raise
            raise click.UsageError(
                f"{len(files)} files, {files[0]} to {files[-1]}; expected one: for a series, quote the pattern so that "
                "the shell does not expand it, as 'run_*.vti'",
                ctx,
            ) from None

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
