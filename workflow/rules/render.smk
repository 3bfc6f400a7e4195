rule render:
    input:
        scene=lambda wildcards: config["scenes"][wildcards.scene],
        surface=look_file("surfaces/{surface}.surface.npz"),
        map=at("maps/{look}.map.npz"),
        model=look_file("models/{sample}.model.npz"),
    output:
        picture=at("pictures/{look}.{scene}.exr"),
        summary=at("summaries/render/{look}.{scene}.json"),
    log:
        at("logs/render/{look}.{scene}.log"),
    benchmark:
        at("benchmarks/render/{look}.{scene}.jsonl")
    conda:
        "../envs/btfpipe.yaml"
    threads: 1
    resources:
        mem_mb=mem_mb(4000),
        memory=MEMORY,
    params:
        width=lookup("film/width", within=config),
        height=lookup("film/height", within=config),
        samples=lookup("film/samples", within=config),
        seed=lookup("seed", within=config),
        code=code("rendering", "compression", "surface", "synthesis", "cli/render.py"),
    message:
        "rendering {wildcards.look} in scene {wildcards.scene}"
    shell:
        "btfpipe render {input.scene:q} --bind surface={input.surface:q} --bind map={input.map:q}"
        " --bind model={input.model:q} --width {params.width} --height {params.height}"
        " --samples {params.samples} --seed {params.seed} --threads {threads} {resources.memory}"
        " --out {output.picture:q} --json > {output.summary:q} 2> {log:q}"


# The same map with the frontal picture as an ordinary texture.
use rule render as render_plain with:
    input:
        scene=lambda wildcards: config["scenes"][wildcards.scene],
        surface=look_file("surfaces/{surface}.surface.npz"),
        map=at("maps/{look}.map.npz"),
        model=look_file("samples/{sample}.plain.npz"),
    output:
        picture=at("pictures/{look}.{scene}.plain.exr"),
        summary=at("summaries/render_plain/{look}.{scene}.json"),
    log:
        at("logs/render_plain/{look}.{scene}.log"),
    benchmark:
        at("benchmarks/render_plain/{look}.{scene}.jsonl")
    message:
        "rendering {wildcards.look} as a plain texture in scene {wildcards.scene}"


rule preview:
    input:
        picture=at("pictures/{look}.{scene}.exr"),
    output:
        png=report(
            at("pictures/{look}.{scene}.png"),
            caption="../report/picture.rst",
            category="Pictures",
            labels={"look": "{look}", "scene": "{scene}"},
        ),
    log:
        at("logs/preview/{look}.{scene}.log"),
    benchmark:
        at("benchmarks/preview/{look}.{scene}.jsonl")
    conda:
        "../envs/btfpipe.yaml"
    threads: 1
    resources:
        mem_mb=mem_mb(1000),
        memory=MEMORY,
    params:
        code=code("rendering", "cli/preview.py"),
    message:
        "tone-mapping {wildcards.look} in scene {wildcards.scene}"
    shell:
        "btfpipe preview {input.picture:q} {resources.memory} --out {output.png:q} --quiet 2> {log:q}"


rule preview_btf_and_texture:
    input:
        btf=at("pictures/{look}.{scene}.exr"),
        plain=at("pictures/{look}.{scene}.plain.exr"),
    output:
        png=report(
            at("pictures/{look}.{scene}.btf-and-texture.png"),
            caption="../report/btf-and-texture.rst",
            category="BTF beside plain texture",
            labels={"look": "{look}", "scene": "{scene}"},
        ),
    log:
        at("logs/preview_btf_and_texture/{look}.{scene}.log"),
    benchmark:
        at("benchmarks/preview_btf_and_texture/{look}.{scene}.jsonl")
    conda:
        "../envs/btfpipe.yaml"
    threads: 1
    resources:
        mem_mb=mem_mb(1000),
        memory=MEMORY,
    params:
        code=code("rendering", "cli/preview.py"),
    message:
        "setting {wildcards.look} beside its plain texture"
    shell:
        "btfpipe preview {input.btf:q} {input.plain:q} --columns 2 {resources.memory}"
        " --out {output.png:q} --quiet 2> {log:q}"
