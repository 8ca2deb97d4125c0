import { existsSync, readFileSync } from "node:fs";
import { join } from "node:path";
import { defineConfig } from "vite";

// Puts the licences of the packages in the script at its begin, as they ask for. After minification, which leaves out
// comments.
const licences = {
  name: "licences",
  generateBundle(_options, bundle) {
    for (const chunk of Object.values(bundle)) {
      if (chunk.type !== "chunk") continue;
      const folders = new Set(Object.keys(chunk.modules).flatMap((id) => /^\0?(.*\/node_modules\/(?:@[^/]+\/)?[^/]+)\//.exec(id)?.[1] ?? []));
      const texts = [...folders].sort().map((folder) => {
        const { name, version } = JSON.parse(readFileSync(join(folder, "package.json"), "utf8"));
        const file = ["LICENSE", "LICENSE.md", "LICENSE.txt", "license"].map((of) => join(folder, of)).find(existsSync);
        if (!file) throw new Error(`${name} has no licence text`);
        return `${name} ${version}\n\n${readFileSync(file, "utf8").trim()}`;
      });
      if (texts.length > 0) chunk.code = `/*!\n${texts.join("\n\n----\n\n").replaceAll("*/", "* /")}\n*/\n${chunk.code}`;
    }
  },
};

// gromad embeds the files of this folder: their names are fixed, and the page has one script and one style sheet.
export default defineConfig({
  base: "./",
  plugins: [licences],
  build: {
    outDir: process.env.GROMA_PAGE_OUT ?? "dist",
    emptyOutDir: true,
    target: "es2021",
    sourcemap: false,
    modulePreload: false,
    reportCompressedSize: true,
    rollupOptions: {
      output: {
        inlineDynamicImports: true,
        entryFileNames: "assets/page.js",
        assetFileNames: (asset) => (asset.name?.endsWith(".css") ? "assets/page.css" : "assets/[name][extname]"),
      },
    },
  },
});
