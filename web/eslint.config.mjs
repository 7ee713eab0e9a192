import tseslint from "typescript-eslint";

export default tseslint.config(
  ...tseslint.configs.strict,
  {
    rules: {
      "@typescript-eslint/no-non-null-assertion": "off",
      "no-restricted-properties": [
        "error",
        { property: "innerHTML", message: "names, titles and phrases are not HTML: use textContent" },
        { property: "outerHTML", message: "names, titles and phrases are not HTML: use textContent" },
        { property: "insertAdjacentHTML", message: "names, titles and phrases are not HTML: use textContent" },
      ],
      "no-eval": "error",
    },
  },
);
