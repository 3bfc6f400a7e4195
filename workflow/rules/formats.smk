rule export:
    input:
        sample=at("samples/{sample}.sample.npz"),
    output:
        file=at("exports/{sample}.{format}.{ending}"),
        summary=at("summaries/export/{sample}.{format}.{ending}.json"),
    log:
        at("logs/export/{sample}.{format}.{ending}.log"),
    benchmark:
        at("benchmarks/export/{sample}.{format}.{ending}.jsonl")
    wildcard_constraints:
        ending="zip|btf",
    conda:
        "../envs/btfpipe.yaml"
    threads: 2
    resources:
        mem_mb=mem_mb(2000),
        memory=MEMORY,
    params:
        # a factorisation that shows no difference to the eye
        terms=lambda wildcards: (
            "--channel-components 160 80 80" if wildcards.format == "btf" else ""
        ),
        code=code("compression", "cli/export.py"),
    message:
        "writing {wildcards.sample} as {wildcards.format}"
    shell:
        "btfpipe export {input.sample:q} --format {wildcards.format} {params.terms}"
        " --threads {threads} {resources.memory} --out {output.file:q} --json > {output.summary:q} 2> {log:q}"


rule ingest_export:
    input:
        file=exported,
    output:
        appearance=at("formats/{sample}.{format}.npz"),
        summary=at("summaries/ingest_export/{sample}.{format}.json"),
    log:
        at("logs/ingest_export/{sample}.{format}.log"),
    benchmark:
        at("benchmarks/ingest_export/{sample}.{format}.jsonl")
    conda:
        "../envs/btfpipe.yaml"
    threads: 2
    resources:
        mem_mb=mem_mb(2000),
        memory=MEMORY,
    params:
        # a list of pairs comes back as one
        pairs=lambda wildcards: "--pairs" if wildcards.format in ("ubo", "utia") else "",
        code=code("compression", "cli/ingest.py"),
    message:
        "reading {wildcards.sample} back from {wildcards.format}"
    shell:
        "btfpipe ingest {input.file:q} {params.pairs}"
        " --threads {threads} {resources.memory} --out {output.appearance:q} --json > {output.summary:q} 2> {log:q}"


rule formats_sheet:
    input:
        sample=at("samples/{sample}.sample.npz"),
        appearances=lambda wildcards: [
            at(f"formats/{wildcards.sample}.{name}.npz")
            for name in EXPORTS[wildcards.sample]
        ],
    output:
        sheet=report(
            at("formats/{sample}.png"),
            caption="../report/formats.rst",
            category="Formats",
            labels={"sample": "{sample}", "what": "written and read back"},
        ),
        table=at("formats/{sample}.md"),
    log:
        at("logs/formats_sheet/{sample}.log"),
    benchmark:
        at("benchmarks/formats_sheet/{sample}.jsonl")
    conda:
        "../envs/btfpipe.yaml"
    params:
        code=code("metrics", "compression"),
    message:
        "laying out {wildcards.sample} as every format gives it back"
    script:
        "../scripts/formats_sheet.py"
