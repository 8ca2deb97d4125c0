# Copies the headers of `folders` of `source` to `target`, with the paths of their includes as they are there.
foreach(folder IN LISTS folders)
  file(GLOB headers RELATIVE ${source} ${source}/${folder}/*.hpp)
  foreach(header IN LISTS headers)
    file(READ ${source}/${header} text)
    string(REPLACE "#include \"host/" "#include \"groma/" text "${text}")
    file(WRITE ${target}/${header} "${text}")
  endforeach()
endforeach()
