# Snakemake: a page of every volume, under one function. The same command leaves the same bytes, so that results can be
# kept between workflows (snakemake --cache).
#
#   snakemake --snakefile splats.smk --cores 4 --config function=bone.json -- head.html
#
# --threads does not change the bytes; --time-budget does (docs/commands/convert.md, "Same command, same bytes").

rule splats:
    input:
        volume="{name}.nrrd",
        function=config.get("function", "tf.json"),
    output:
        "{name}.html",
    log:
        "{name}.log",
    params:
        options=config.get("options", ""),
    threads: 4
    cache: "omit-software"
    shell:
        "vvgt convert {input.volume} --tf {input.function} {params.options} --threads {threads} -o {output} 2> {log}"
