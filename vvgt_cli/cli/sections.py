"""The class of all commands: `--help` in sections, the options most people need first, and one value an option."""

from __future__ import annotations

import copy
import os

import click

SECTIONS = {  # parameters by name, in the order shown; all others come first, under "Options"
    "Input": "dims dtype byte_order header_bytes spacing space array component time suv crop mask keep_largest",
    "Look": "iso tf_range opacity_unit_distance labels layers ambient diffuse specular specular_power occlusion",
    "Quality": "steps init model rule seed renderer samples step",
    "Output": "frame up camera sh_degree comments split_labels slices format half background points report conditions",
    "Running": "dry_run device checkpoint shard block_size workers scheduler level threads memory quiet",
}


class SectionedCommand(click.Command):
    """A command that lists its options under the headings of `SECTIONS`, and takes one value of most of them."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments; where there are more files than expected, say how a series is given.

        Raises:
            click.UsageError: invalid arguments, or several values of an option that is not repeatable.
        """
        given = list(args)
        try:
            self._check_repeated(ctx, list(args))
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

    def _check_repeated(self, ctx: click.Context, args: list[str]) -> None:
        """Raise click.UsageError for an option with several values, of which click would take the last."""
        parser = self.make_parser(ctx)
        options = [param for param in self.get_params(ctx) if isinstance(param, click.Option) and not param.multiple]
        for option in options:
            collecting = copy.copy(option)
            collecting.multiple = True
            collecting.add_to_parser(parser, ctx)
        collected = parser.parse_args(args)[0]
        for option in options:
            values = collected.get(option.name, [])
            if len(values) > 1 and not (option.is_flag and len(set(values)) == 1):
                names = "/".join([*option.opts, *option.secondary_opts])
                words = " and ".join(_word(option, value) for value in values)
                raise click.UsageError(f"{names}: given {len(values)} times, {words}; expected one", ctx)

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


def _word(option: click.Option, value: object) -> str:
    """Return a value of an option as it was typed; of a flag its name, and the default of a value that is omitted."""
    if isinstance(value, bool):
        return (option.opts if value else option.secondary_opts)[0]
    return " ".join(value) if isinstance(value, tuple) else str(value if isinstance(value, str) else option.flag_value)
