rule ingest:
    input:
        source=lambda wildcards: config["samples"][wildcards.sample]["source"],
    output:
        sample=at("samples/{sample}.sample.npz"),
        summary=at("summaries/ingest/{sample}.json"),
    log:
        at("logs/ingest/{sample}.log"),
    benchmark:
        at("benchmarks/ingest/{sample}.jsonl")
    conda:
        "../envs/btfpipe.yaml"
    threads: 2
    resources:
        mem_mb=mem_mb(1000),
        memory=MEMORY,
    params:
        options=sample_options,
        code=code("compression", "cli/ingest.py"),
    message:
        "ingesting {wildcards.sample}"
    shell:
        "btfpipe ingest {input.source:q} {params.options}"
        " --threads {threads} {resources.memory} --out {output.sample:q} --json > {output.summary:q} 2> {log:q}"


rule ingest_frontal:
    input:
        source=lambda wildcards: config["samples"][wildcards.sample]["source"],
    output:
        sample=at("samples/{sample}.plain.npz"),
        summary=at("summaries/ingest_frontal/{sample}.json"),
    log:
        at("logs/ingest_frontal/{sample}.log"),
    benchmark:
        at("benchmarks/ingest_frontal/{sample}.jsonl")
    conda:
        "../envs/btfpipe.yaml"
    threads: 1
    resources:
        mem_mb=mem_mb(1000),
        memory=MEMORY,
    params:
        options=sample_options,
        code=code("compression", "cli/ingest.py"),
    message:
        "taking the frontal picture of {wildcards.sample}"
    shell:
        "btfpipe ingest {input.source:q} --frontal {params.options}"
        " --threads {threads} {resources.memory} --out {output.sample:q} --json > {output.summary:q} 2> {log:q}"


rule ingest_truth:
    input:
        source=at("samples/{sample}.truth.zip"),
    output:
        sample=at("samples/{sample}.truth.npz"),
        summary=at("summaries/ingest_truth/{sample}.json"),
    log:
        at("logs/ingest_truth/{sample}.log"),
    benchmark:
        at("benchmarks/ingest_truth/{sample}.jsonl")
    conda:
        "../envs/btfpipe.yaml"
    threads: 1
    resources:
        mem_mb=mem_mb(1000),
        memory=MEMORY,
    params:
        code=code("compression", "cli/ingest.py"),
    message:
        "ingesting the ground truth of {wildcards.sample}"
    shell:
        "btfpipe ingest {input.source:q} --pairs"
        " --threads {threads} {resources.memory} --out {output.sample:q} --json > {output.summary:q} 2> {log:q}"
