import { defineConfig } from "vite";

// gromad embeds the files of this folder: their names are fixed, and the page has one script and one style sheet.
export default defineConfig({
  base: "./",
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
