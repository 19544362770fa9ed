# Snakemake: a page of every volume, under one function. The same command leaves the same bytes, so that results can be
# kept between workflows: snakemake --cache, with their folder in the environment variable SNAKEMAKE_OUTPUT_CACHE. The
# version of vvgt is not in the cache's key ("omit-software"): clear the folder when you update it.
#
#   export SNAKEMAKE_OUTPUT_CACHE=~/.cache/splats
#   mkdir -p $SNAKEMAKE_OUTPUT_CACHE
#   snakemake --snakefile splats.smk --cores 4 --cache --config function=bone.json -- head.html
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
